"""FloodDiffusion's parts: its clocks and window in exact numbers, its field by the continuity equation, its training.

What the paper prints wrongly is in test_errata_flows.py; here the right thing is held to what it has to be.
"""

from fractions import Fraction
from math import floor
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import make_tiny_preset
from model_helpers import randomise

from minicmdm.asking import usual_sampling
from minicmdm.config import DiTConfig, preset
from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.diffusion.gaussian import ar1_covariance, bayes_velocity, visible
from minicmdm.diffusion.path import interpolate, velocity
from minicmdm.diffusion.sampling import sample
from minicmdm.diffusion.schedules import cost, schedule_matrix
from minicmdm.diffusion.streaming import LONGEST, LatentStream
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import Words
from minicmdm.systems.flood import (
    NEAR_NOISE,
    TARGETS,
    TICKS,
    active_window,
    conditional_score,
    conditional_velocity,
    draw_triangle,
    last_moment,
    to_velocity,
    triangle,
)
from minicmdm.training.batches import DenoiserBatch
from minicmdm.training.denoiser import denoising_loss

PLANS = [(1, 1, 1), (2, 1, 4), (7, 3, 3), (12, 5, 10), (12, 5, 50), (12, 5, 100), (20, 7, 49), (3, 8, 24)]  # N, n_s, K
every_plan = pytest.mark.parametrize(("latents", "overlap", "steps"), PLANS)


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


# --- clocks and window ------------------------------------------------------------------------------------------------


@every_plan
def test_times_are_eqs_19_and_20_and_the_rows_of_the_matrix(latents, overlap, steps):
    matrix = schedule_matrix(latents, steps, kind="triangular", overlap=overlap)
    for call, levels in enumerate(matrix):
        moment = Fraction(call, steps)
        right = [min(max(moment - Fraction(k, overlap), 0), 1) for k in range(latents)]
        t = triangle(float(moment), latents, overlap)
        assert t.shape == (latents,) and t.dtype == torch.float64
        assert t.tolist() == pytest.approx([float(x) for x in right], abs=1e-12)
        assert [1 - Fraction(int(level), steps) for level in levels] == right
    assert len(matrix) - 1 == round(steps * last_moment(latents, overlap))


@every_plan
def test_the_window_is_what_the_triangular_matrix_moves(latents, overlap, steps):
    matrix = schedule_matrix(latents, steps, kind="triangular", overlap=overlap)
    for call, moves in enumerate(matrix[1:] < matrix[:-1]):
        for clock in (call / steps, call * (1 / steps)):  # which differ in their last bit, and so did the released code
            assert [*range(*active_window(clock, latents, overlap))] == np.flatnonzero(moves).tolist(), call
    first, end = active_window(last_moment(latents, overlap), latents, overlap)
    assert first >= end  # all is done
    assert cost(matrix).latents_in_flight == min(latents, overlap)


def test_the_window_holds_from_its_moment_on():
    """Right-continuous: the latent that begins at 0.6 is in the window of the step from 0.6, not a moment sooner."""
    assert active_window(0.6 - 1e-6, 12, 5) == (0, 3)
    assert active_window(0.6, 12, 5) == active_window(0.6 + 1e-6, 12, 5) == (0, 4)
    assert active_window(1 - 1e-6, 12, 5) == (0, 5)
    assert active_window(1.0, 12, 5) == (1, 6)  # latent 0 is clean and makes no step
    assert active_window(0.0, 12, 5) == (0, 1) and active_window(3.2, 12, 5) == (12, 12)


@pytest.mark.parametrize(("latents", "overlap"), [(1, 1), (9, 1), (9, 4), (30, 5), (4, 7)])
def test_lemma_36_what_is_outside_the_window_is_saturated(latents, overlap):
    end = last_moment(latents, overlap)
    for moment in np.random.default_rng(0).uniform(0, end, 200):
        t = triangle(moment, latents, overlap)
        m, n = active_window(moment, latents, overlap)
        assert (t[:m] == 1).all() and (t[n:] == 0).all() and 0 < n - m <= overlap
        assert ((0 < t[m:n]) & (t[m:n] < 1)).all()  # and at a random moment all inside is on its way
        assert (m, n) == (max(0, floor((moment - 1) * overlap) + 1), min(latents, floor(moment * overlap) + 1))
    assert (triangle(end, latents, overlap) > 1 - 1e-12).all() and triangle(end - 1e-3, latents, overlap)[-1] < 1


# --- what training draws ----------------------------------------------------------------------------------------------


def some_lengths(batch, longest, seed=0):
    lengths = torch.randint(1, longest + 1, (batch,), generator=rng(seed))
    return torch.arange(longest) < lengths[:, None], lengths


@pytest.mark.parametrize("overlap", [1, 3, 5, 9])
def test_training_sees_triangles_and_nothing_else_in_whole_numbers(overlap):
    valid, lengths = some_lengths(1500, 11)
    t, finished, shown = draw_triangle(valid, overlap, rng(1))
    unit = TICKS * overlap
    ticks = (t.double() * unit).round()
    assert (t.double() * unit - ticks).abs().max() < 1e-4  # the times lie on the grid
    draining = False
    for b, (row, done, up_to) in enumerate(zip(ticks.int().tolist(), finished.sum(1).tolist(), shown.sum(1).tolist())):
        length, since = int(lengths[b]), row[done] + TICKS * done  # the moment, by the clock of the first one in flight
        assert done < up_to <= length and up_to - done <= overlap  # always someone to ask, never more than n_s
        assert finished[b, :done].all() and shown[b, :up_to].all()  # past, window, future, from left to right
        assert row == [min(max(since - TICKS * k, 0), unit) for k in range(11)]
        assert since < unit + TICKS * (length - 1)  # its own last latent is not clean yet
        assert active_window(since / unit, length, overlap) == (done, up_to)
        draining |= since >= TICKS * length
    assert draining == (overlap > 1)  # windows that no new latent enters occur, as they will in sampling


def test_moments_are_uniform_over_the_life_of_each_triangle():
    overlap, length = 4, 6
    valid = torch.ones(20_000, length, dtype=torch.bool)
    t, finished, shown = draw_triangle(valid, overlap, rng(2))
    # the sum of all clocks grows with the moment: count from it which moment it was
    whole = TICKS * (overlap + length - 1)
    ticks = torch.stack([triangle(i / (TICKS * overlap), length, overlap) for i in range(whole)]).sum(1)
    found = (t.double().sum(1)[:, None] - ticks).abs().argmin(1)
    counts, expected = torch.bincount(found, minlength=whole).double(), len(valid) / whole
    assert ((counts - expected) ** 2 / expected).sum() < whole + 5 * (2 * whole) ** 0.5  # chi squared


def test_the_seed_decides_what_is_drawn():
    valid, _ = some_lengths(50, 9)
    first, again, other = (draw_triangle(valid, 3, rng(seed)) for seed in (0, 0, 1))
    assert all(torch.equal(a, b) for a, b in zip(first, again)) and not torch.equal(first[0], other[0])
    torch.manual_seed(5)
    wanted = draw_triangle(valid, 3)
    torch.manual_seed(5)
    assert torch.equal(draw_triangle(valid, 3)[0], wanted[0])


# --- the field --------------------------------------------------------------------------------------------------------


def test_the_velocity_is_the_derivative_of_the_path():
    z, eps = torch.randn(2, 9, 3, generator=rng(), dtype=torch.float64)
    place = torch.arange(9, dtype=torch.float64)

    def triangular(s):
        return triangle(s, 9, 4), 1 - triangle(s, 9, 4)

    def curved(s):  # any vectorised schedule will do (Definition 3.1)
        angle = torch.pi / 2 * (s - place / 10).clamp(0, 1) ** 2
        return angle.sin(), angle.cos()

    for schedule in (triangular, curved):
        for s in (0.33, 1.33, 1.87):
            (low_a, low_b), (high_a, high_b) = schedule(s - 1e-6), schedule(s + 1e-6)
            rates = (high_a - low_a) / 2e-6, (high_b - low_b) / 2e-6
            moved = high_a[:, None] * z + high_b[:, None] * eps - low_a[:, None] * z - low_b[:, None] * eps
            u = conditional_velocity(z, eps, *rates)
            torch.testing.assert_close(u, moved / 2e-6, rtol=1e-6, atol=1e-6)
            alpha, beta = (x[:, None] for x in schedule(s))
            x, (da, db) = alpha * z + beta * eps, (rate[:, None] for rate in rates)
            printed = (da - db / beta * alpha) * z + db / beta * x  # Eq. 8
            fine = (beta > 1e-9).expand_as(u)
            torch.testing.assert_close(u[fine], printed[fine])
            assert u.isfinite().all() and (u[~fine] == 0).all()


def test_the_score_is_the_gradient_of_the_log_density():
    z, eps = torch.randn(2, 7, 3, generator=rng(), dtype=torch.float64)
    alpha = triangle(1.23, 7, 4)
    x = interpolate(z[None], eps[None], alpha[None])[0].requires_grad_()
    inside = slice(*active_window(1.23, 7, 4))
    a, b = alpha[inside, None], 1 - alpha[inside, None]
    torch.distributions.Normal(a * z[inside], b).log_prob(x[inside]).sum().backward()
    score = conditional_score(x.detach(), z, alpha, 1 - alpha)
    torch.testing.assert_close(score[inside], x.grad[inside])
    assert (score[: inside.start] == 0).all()
    torch.testing.assert_close(score[inside.stop :], -x.detach()[inside.stop :])


N, OVERLAP, MIX = 10, 4, 3


def mixture(seed=0):
    """Data with an analytic posterior that are neither Gaussian nor forgetful: weights, means (M,N), covariances."""
    luck = np.random.default_rng(seed)
    halves = luck.normal(size=(MIX, N, N))
    return np.array([0.5, 0.3, 0.2]), 2 * luck.normal(size=(MIX, N)), halves @ halves.mT / N + 0.2 * np.eye(N)


def log_density(x, t, data):
    """log p of x (n,) at times t (n,), and each component's share; only the first n latents exist."""
    n, parts = len(x), []
    for weight, mean, cov in zip(*data):
        noisy = t[:, None] * cov[:n, :n] * t + np.diag((1 - t) ** 2)
        off = x - t * mean[:n]
        parts.append(np.log(weight) - 0.5 * (off @ np.linalg.solve(noisy, off) + np.linalg.slogdet(noisy)[1]))
    top = max(parts)
    share = np.exp(np.array(parts) - top)
    return top + np.log(share.sum()), share / share.sum()


def field(x, t, window, data):
    """E[u | x] (n,) by Bayes, with the library's u and its window's rates."""
    n, share = len(x), log_density(x, t, data)[1]
    z, eps = np.zeros((2, n))
    for part, mean, cov in zip(share, *data[1:]):
        noisy = t[:, None] * cov[:n, :n] * t + np.diag((1 - t) ** 2)
        solved = np.linalg.solve(noisy, x - t * mean[:n])
        z += part * (mean[:n] + cov[:n, :n] * t @ solved)
        eps += part * (1 - t) * solved
    rate = torch.zeros(n, dtype=torch.float64)
    rate[slice(*window)] = 1
    return conditional_velocity(torch.tensor(z)[:, None], torch.tensor(eps)[:, None], rate, -rate)[:, 0].numpy()


@pytest.mark.parametrize("moment", [0.11, 0.9, 1.37, 2.1, 3.05])
def test_the_field_obeys_the_continuity_equation(moment):
    """ds log p + div u + u . grad log p = 0 (Prop. 3.2, Eq. 35), all three by differences, data a mixture."""
    data, h = mixture(), 1e-5
    t = triangle(moment, N, OVERLAP).numpy()
    window = active_window(moment, N, OVERLAP)
    for x in np.random.default_rng(1).normal(size=(5, N)):
        later, sooner = (log_density(x, triangle(moment + d, N, OVERLAP).numpy(), data)[0] for d in (h, -h))
        nudges = h * np.eye(N)
        divergence = sum(
            (field(x + d, t, window, data)[k] - field(x - d, t, window, data)[k]) / (2 * h)
            for k, d in enumerate(nudges)
        )
        slope = np.array([(log_density(x + d, t, data)[0] - log_density(x - d, t, data)[0]) / (2 * h) for d in nudges])
        u = field(x, t, window, data)
        assert (later - sooner) / (2 * h) + divergence + u @ slope == pytest.approx(0, abs=1e-5 * (1 + abs(divergence)))


@pytest.mark.parametrize("moment", [0.11, 0.9, 1.37, 2.1, 3.05])
def test_theorem_38_the_field_is_local(moment):
    """Outside the window it is 0; inside it needs x up to the window's end, all of it, and nothing after."""
    data, t = mixture(2), triangle(moment, N, OVERLAP).numpy()
    m, n = window = active_window(moment, N, OVERLAP)
    x = np.random.default_rng(3).normal(size=N)
    u = field(x, t, window, data)
    assert not u[:m].any() and not u[n:].any() and (u[m:n] != 0).all()
    assert u[:n] == pytest.approx(field(x[:n], t[:n], window, data), abs=1e-9)  # who waits need not exist
    for k in range(N):
        moved = x.copy()
        moved[k] += 1
        change = np.abs(field(moved, t, window, data) - u)[m:n]
        assert (change > 1e-9).all() if k < n else (change < 1e-10).all(), k


@pytest.mark.parametrize("moment", [0.55, 1.33, 1.9])
def test_the_window_needs_bidirectional_attention(moment):
    """With the mean given the past alone, the covariance does not grow as it has to; with the window's, it does."""
    data, t = ar1_covariance(N, 0.9), triangle(moment, N, OVERLAP).numpy()
    rate = np.zeros(N)
    rate[slice(*active_window(moment, N, OVERLAP))] = 1
    noisy = t[:, None] * data * t + np.diag((1 - t) ** 2)
    growth = rate[:, None] * data * t + t[:, None] * data * rate - 2 * np.diag((1 - t) * rate)
    for mask in ("bidirectional", "window", "causal"):
        flow = rate[:, None] * bayes_velocity(data, t, visible(1 - t, t == 0, mask))
        error = np.abs(flow @ noisy + noisy @ flow.T - growth).max()
        assert error > 0.05 if mask == "causal" else error < 1e-12


# --- what a network may predict ---------------------------------------------------------------------------------------


def test_every_target_stands_for_the_same_velocity():
    z, eps, noise = torch.randn(3, 4, 9, 3, generator=rng(), dtype=torch.float64)
    t = NEAR_NOISE + (0.99 - NEAR_NOISE) * torch.rand(4, 9, generator=rng(1), dtype=torch.float64)
    z_t, v = interpolate(z, eps, t), velocity(z, eps)
    for target, perfect in {"v": v, "x0": z, "eps": eps}.items():
        torch.testing.assert_close(to_velocity(perfect, target, z_t, t), v)
    off = 0.1 * noise  # errors scale as they must: of v as they are, of x0 by 1/(1-t), of eps by -1/t
    scale = {"v": torch.ones_like(t), "x0": 1 / (1 - t), "eps": -1 / t}
    for target, perfect in {"v": v, "x0": z, "eps": eps}.items():
        found = to_velocity(perfect + off, target, z_t, t) - v
        torch.testing.assert_close(found, scale[target][..., None] * off, rtol=1e-6, atol=1e-9)
    assert set(scale) == set(TARGETS)


def test_no_target_explodes_where_a_latent_begins_or_is_finished():
    z, eps, guess = torch.randn(3, 2, 5, 3, generator=rng())
    for end in (0.0, 1.0):
        t = torch.full((2, 5), end)
        z_t = interpolate(z, eps, t)
        for target in TARGETS:
            assert to_velocity(guess, target, z_t, t).isfinite().all()
        torch.testing.assert_close(to_velocity(guess, "x0", z_t, t), (guess - z_t) * (end == 0))  # or rests
    assert (
        to_velocity(guess, "eps", eps, torch.zeros(2, 5)).abs().max() <= 1.01 * (eps - guess).abs().max() / NEAR_NOISE
    )
    with pytest.raises(ValueError, match="v, x0, eps"):
        to_velocity(z, "score", z, torch.zeros(2, 5))


# --- training and sampling with it ------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", TARGETS)
def test_the_loss_counts_the_latents_in_flight_alone(target):
    valid, _ = some_lengths(20, 8)
    z = torch.randn(20, 8, 3, generator=rng())
    t, finished, shown = draw_triangle(valid, 3, rng(3))
    flying = shown & ~finished

    def loss(error):
        """Of a model whose answer is off by error (B,N) in flight, and no number elsewhere."""

        def model(noisy, times, words, word_mask, visible, clock, committed):
            assert torch.equal(visible, shown) and torch.equal(committed, finished) and torch.equal(times, t)
            assert torch.equal(noisy[finished], z[finished])  # the past is clean
            eps = torch.randn(z.shape, generator=rng(4))  # as the loss will have drawn it
            answer = {"v": z - eps, "x0": z, "eps": eps}[target] + error[..., None]
            return answer.masked_fill(~flying[..., None], torch.nan)

        how = dict(generator=rng(4), target=target, committed=finished, t=t)
        return diffusion_forcing_loss(model, z, None, None, shown, **how).item()

    assert loss(torch.zeros(20, 8)) == pytest.approx(0, abs=1e-6)
    assert loss(torch.full((20, 8), 2.0)) == pytest.approx(4)
    one = torch.zeros(20, 8)
    one[tuple(flying.nonzero()[5])] = 3.0
    assert loss(one) == pytest.approx(9 / int(flying.sum()))


class Spy(torch.nn.Module):
    """A denoiser that says nothing and remembers what it was shown."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def read(self, words):
        return words

    def forward(self, noisy, t, words, word_mask, valid, clock, committed=None):
        self.t, self.valid, self.committed = t, valid, committed
        return noisy * self.weight


def test_the_last_stage_trains_on_triangles_of_its_plan():
    valid, _ = some_lengths(16, 9)
    nobody = torch.zeros(16, 9, dtype=torch.long)
    batch = DenoiserBatch(
        torch.randn(16, 9, 4, generator=rng()), valid, ["a"], nobody[:, :1], nobody, torch.zeros(16, 9, 2)
    )
    words, spy = (
        SimpleNamespace(encode=lambda _: Words(torch.zeros(1, 2, 16), torch.ones(1, 2, dtype=torch.bool))),
        Spy(),
    )
    for overlap in (2, 5):
        denoising_loss(spy, words, batch, make_tiny_preset(levels="triangle", overlap=overlap), 0.0, rng(9))
        t, finished, shown = draw_triangle(valid, overlap, rng(9))
        assert torch.equal(spy.t[shown], t[shown]) and torch.equal(spy.committed, finished)
        assert torch.equal(spy.valid, shown)


@pytest.mark.parametrize("system", ["flood", "window"])
def test_presets_sample_the_triangle_that_they_train(system):
    for name in ("toy", "M"):
        plan = preset(name, system)
        kind = {"flood": ("bidirectional", "triangle"), "window": ("window", "tiled")}[system]
        assert (plan.dit.attention, plan.train.levels) == kind and plan.dit.target == "v"
        how = usual_sampling(system, None, None, None)
        assert how["schedule"] == "triangular" and -(-how["num_steps"] // how["uncertainty"]) == plan.train.overlap


def make_model(attention):
    shape = dict(latent_dim=3, text_dim=5, dim=16, layers=2, heads=2, time_dim=8, clock=True)
    model = randomise(CausalDiT(DiTConfig(**shape, attention=attention)))
    words = Words(torch.randn(1, 4, 16, generator=rng(), dtype=torch.float64), torch.ones(1, 4, dtype=torch.bool))

    def denoise(z, t):
        return model(z, t, words.embeddings.expand(len(z), -1, -1), words.mask[:, None].expand(*z.shape[:2], -1))

    return model, words, denoise


@pytest.mark.parametrize(("steps", "stagger"), [(6, 2), (10, 2), (4, 4), (5, 2)])
def test_a_bidirectional_model_streams_what_the_dense_sampler_gives(steps, stagger):
    model, words, denoise = make_model("bidirectional")
    how = dict(schedule="triangular", num_steps=steps, uncertainty=stagger, guidance_scale=1.0, num_latents=11)
    stream = LatentStream(model, lambda _: words, words, ["walk"], [rng(6)], **how)
    noise = torch.randn(LONGEST, 3, generator=rng(6))[None, :11].double()
    matrix = schedule_matrix(11, steps, stagger, kind="triangular")
    torch.testing.assert_close(stream.drain(), sample(denoise, matrix, noise), rtol=1e-9, atol=1e-9)
    assert stream.calls == len(matrix) - 1


@pytest.mark.parametrize("attention", ["bidirectional", "causal"])
@pytest.mark.parametrize("overlap", [1, 2, 4])
def test_a_sample_hears_of_the_window_and_of_nothing_later(attention, overlap):
    """Latent i depends on the noise of those that started before it was clean: up to i + n_s - 1, or to i if causal."""
    denoise = make_model(attention)[2]
    noise = torch.randn(1, 8, 3, generator=rng(7), dtype=torch.float64).repeat(9, 1, 1)
    noise[1:][torch.eye(8, dtype=torch.bool)] += 1  # sample 1 + j has another latent j
    base, *others = sample(denoise, schedule_matrix(8, 4, kind="triangular", overlap=overlap), noise)
    found = torch.stack([(other - base).abs().amax(1) > 1e-9 for other in others], dim=1)  # (i,j)
    place, ahead = torch.arange(8), overlap - 1 if attention == "bidirectional" else 0
    assert torch.equal(found, place <= place[:, None] + ahead)
