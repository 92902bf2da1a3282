"""The sampler: right on Gaussians for every schedule, causal from noise to decoded frame, and still when told."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.config import DiTConfig, VAEConfig
from minicmdm.diffusion import sampling
from minicmdm.diffusion.path import level_to_time, velocity_to_noise
from minicmdm.diffusion.sampling import SOLVERS, from_noise_prediction, guided, sample, sample_steps
from minicmdm.diffusion.schedules import KINDS, schedule_matrix
from minicmdm.models.dit import CausalDiT
from minicmdm.models.vae import MACVAE

TINY = DiTConfig(latent_dim=3, text_dim=5, dim=16, layers=2, heads=2, time_dim=8)


def noise(batch, latents, channels, seed=0):
    return torch.randn(batch, latents, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def text(batch, latents, words, seed=1):
    return noise(batch, words, 16, seed), torch.ones(batch, latents, words, dtype=torch.bool)


# --- Gaussians: the best possible velocity is known, so the right answer is too -------------------------------------


def gaussian_velocity(mean, covariance, causal=False):
    """E[z - eps | z_t] when z ~ N(mean, covariance) over N latents of one channel, each at its own time."""

    def denoise(z_t, t):
        t, v = t[0], torch.empty_like(z_t)
        count = z_t.shape[1]  # waiting latents are hidden; they are pure noise and know nothing
        for n in range(count):
            seen = n + 1 if causal else count
            T = torch.diag(t[:seen])
            T_noise = torch.eye(seen, dtype=z_t.dtype) - T
            C = covariance[:seen, :seen]
            gain = (C @ T - T_noise) @ torch.linalg.inv(T @ C @ T + T_noise @ T_noise)  # Cov(v, z_t) Cov(z_t)^-1
            centred = z_t[:, :seen, 0] - t[:seen] * mean[:seen]
            v[:, n, 0] = mean[n] + centred @ gain[n]
        return v

    return denoise


MEAN = torch.tensor([0.5, -1.0, 2.0, 0.0], dtype=torch.float64)
COVARIANCE = 0.8 ** (torch.arange(4)[:, None] - torch.arange(4)).abs().double() * 0.7  # neighbours correlate


def moments(denoise, matrix, **how):
    """The sampler is affine in all its noise here, so its mean and covariance are exact: no sampling error.

    The batch holds zero, then one unit for each number of the first noise, then one for each number drawn later.
    """
    units = torch.eye(4 * len(matrix), dtype=torch.float64).reshape(-1, len(matrix), 4, 1)
    units = torch.cat([torch.zeros_like(units[:1]), units])  # (1 + 4M, M, 4, 1)
    draws = iter(units.unbind(1))
    start = next(draws)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampling.torch, "randn", lambda *_, **__: next(draws))
        out = sample(denoise, matrix, start, generator=torch.Generator(), **how)[..., 0]
    linear = (out[1:] - out[0]).T
    return out[0], linear @ linear.T


@pytest.mark.parametrize("kind", KINDS)
def test_each_schedule_lands_on_the_right_mean_and_variance(kind):
    variance = torch.diag(torch.tensor([0.25, 1.0, 4.0, 0.09]).double())
    mean, covariance = moments(gaussian_velocity(MEAN, variance, causal=True), schedule_matrix(4, 200, 30, kind=kind))
    assert torch.allclose(mean, MEAN, atol=1e-9)
    assert torch.allclose(covariance, variance, rtol=0.03, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_correlated_latents_come_out_correlated_whatever_the_schedule(kind):
    denoise = gaussian_velocity(MEAN, COVARIANCE)
    errors = []
    for num_steps in (50, 100):
        mean, covariance = moments(denoise, schedule_matrix(4, num_steps, num_steps // 5, kind=kind))
        assert torch.allclose(mean, MEAN, atol=1e-9)
        errors.append((covariance - COVARIANCE).abs().max().item())
    assert errors[1] < 0.02 and errors[1] < 0.6 * errors[0]  # Euler: half the step, half the error


def test_a_causal_denoiser_is_exact_when_autoregressive_and_not_when_all_move_together():
    denoise = gaussian_velocity(MEAN, COVARIANCE, causal=True)
    _, turn = moments(denoise, schedule_matrix(4, 100, kind="autoregressive"))
    _, full = moments(denoise, schedule_matrix(4, 100, kind="full"))
    assert (turn - COVARIANCE).abs().max() < 0.02
    assert (full - COVARIANCE).abs().max() > 0.05


# --- solvers ---------------------------------------------------------------------------------------------------------

VARIANCE = torch.diag(torch.tensor([0.25, 1.0, 4.0, 0.09]).double())
HOW = [
    dict(solver="euler", path="ddpm"),
    dict(solver="heun", path="flow"),
    dict(solver="heun", path="ddpm"),
    dict(solver="ddim", path="ddpm"),
    dict(solver="ddim", path="flow", eta=0.5),
    dict(solver="ddpm", path="flow"),
    dict(solver="ddpm", path="ddpm"),
]


def assert_lands(mean, covariance, variance=VARIANCE, atol=1e-9, rtol=0.05):
    assert torch.allclose(mean, MEAN, atol=atol)
    assert torch.allclose(covariance, variance, rtol=rtol, atol=1e-9)


def most_wrong(how):
    """How far a variance may be off after 100 steps. Every first-order solver leaves too little, DDPM least of all."""
    return {"heun": 1e-3, "ddpm": 0.12}.get(how["solver"], 0.05)


@pytest.mark.parametrize("how", HOW, ids=lambda how: "-".join(str(x) for x in how.values()))
def test_each_solver_lands_on_the_right_mean_and_variance(how):
    denoise = gaussian_velocity(MEAN, VARIANCE, causal=True)
    for kind in ("full", "fss"):
        assert_lands(*moments(denoise, schedule_matrix(4, 100, 10, kind=kind), **how), rtol=most_wrong(how))


@pytest.mark.parametrize("how", HOW, ids=lambda how: "-".join(str(x) for x in how.values()))
def test_each_solver_keeps_correlation_and_its_error_falls_with_the_step(how):
    denoise, errors = gaussian_velocity(MEAN, COVARIANCE), []
    for num_steps in (30, 60):
        mean, covariance = moments(denoise, schedule_matrix(4, num_steps, num_steps // 3), **how)
        assert torch.allclose(mean, MEAN, atol=1e-9)
        errors.append((covariance - COVARIANCE).abs().max().item())
    # Half the step: half the error, or with Heun a quarter.
    assert errors[1] < most_wrong(how) and errors[1] < (0.3 if how["solver"] == "heun" else 0.6) * errors[0]


def vp(t):
    """The signal and noise of the variance-preserving path that match flow time t."""
    scale = (t**2 + (1 - t) ** 2).sqrt()
    return (t / scale).unsqueeze(-1), ((1 - t) / scale).unsqueeze(-1)


def trap_step(z_t, v, t_from, t_to, eta, fresh):
    """The right step's formula with the variance-preserving path's coefficients, on latents of the flow."""
    (a, b), (a_to, b_to) = vp(t_from), vp(t_to)
    new = eta * (b_to / b) * (1 - (a / a_to) ** 2).clamp_min(0).sqrt()
    eps = velocity_to_noise(z_t, v, t_from)
    step = a_to * (z_t - b * eps) / a.clamp_min(1e-3) + (b_to**2 - new**2).clamp_min(0).sqrt() * eps
    return torch.where(t_from[..., None] != t_to[..., None], step + (new * fresh if eta else 0), z_t)


@pytest.mark.parametrize("solver", ["ddim", "ddpm"])
def test_vp_coefficients_on_flow_latents_are_the_trap(monkeypatch, solver):
    monkeypatch.setattr(sampling, "ddim_step", trap_step)
    landed = moments(gaussian_velocity(MEAN, VARIANCE, causal=True), schedule_matrix(4, 100, 10), solver=solver)
    with pytest.raises(AssertionError):
        assert_lands(*landed)
    with pytest.raises(AssertionError):  # nor is it a matter of a few percent
        assert_lands(*landed, atol=0.1, rtol=0.3)


@pytest.mark.parametrize("path", ["flow", "ddpm"])
def test_ddpm_is_the_textbook_posterior_on_its_own_path(path):
    """Ho et al. 2020, Eq. 7, on x = s z_t: another state, other coefficients, the same motion."""
    matrix, start = schedule_matrix(4, 7, 2), noise(2, 4, 3)
    t = level_to_time(torch.from_numpy(matrix).double(), 7, path)  # (M,N)
    steps = list(sample_steps(wavy, matrix, start, solver="ddpm", path=path, generator=seeded(3)))
    x, generator = start, seeded(3)
    for row in range(1, len(matrix)):
        fresh = torch.randn(x.shape, generator=generator, dtype=x.dtype)
        for n in np.flatnonzero(matrix[row] != matrix[row - 1]):
            (a, b), (a_to, b_to) = vp(t[row - 1, n]), vp(t[row, n])
            alpha = (a / a_to) ** 2
            x_n, scale = x[:, n], a + b
            v = wavy(x_n / scale, t[row - 1, n].expand(2))
            data = (x_n - b * (x_n / scale - t[row - 1, n] * v)) / a if a > 0 else x_n + v
            mean = (a_to * (1 - alpha) * data + alpha.sqrt() * b_to**2 * x_n) / b**2
            x = x.clone()
            x[:, n] = mean + (b_to**2 / b**2 * (1 - alpha)).sqrt() * fresh[:, n]
        a, b = vp(t[row])
        torch.testing.assert_close(steps[row].z, x / (a + b), rtol=1e-9, atol=1e-9)
    assert (steps[-1].z - start).abs().min() > 1e-6


def wavy(z_t, t):
    return torch.sin(3 * z_t) + t.unsqueeze(-1)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def test_ddim_without_new_noise_is_euler_and_the_seed_decides_the_rest():
    matrix, start = schedule_matrix(4, 6, 2), noise(2, 4, 3)
    assert torch.equal(sample(wavy, matrix, start, solver="ddim"), sample(wavy, matrix, start))
    one, same, other = (sample(wavy, matrix, start, solver="ddpm", generator=seeded(s)) for s in (1, 1, 2))
    assert torch.equal(one, same) and (one - other).abs().min() > 1e-6
    stochastic = sample(wavy, matrix, start, solver="ddim", eta=1.0, generator=seeded(1))
    assert torch.equal(one, stochastic)


def test_heun_asks_twice_a_row_and_the_others_once():
    matrix, calls = schedule_matrix(3, 4, 2), []
    for solver in SOLVERS:
        sample(lambda z_t, t: calls.append(1) or z_t, matrix, noise(2, 3, 1), solver=solver, generator=seeded(0))
        assert len(calls) == (2 if solver == "heun" else 1) * (len(matrix) - 1)
        calls.clear()


def test_a_row_in_which_nothing_moves_costs_nothing():
    matrix, calls = np.array([[2, 2], [1, 2], [1, 2], [0, 1], [0, 0]]), []
    steps = list(sample_steps(lambda z_t, t: calls.append(1) or z_t, matrix, noise(1, 2, 1)))
    assert len(calls) == 3 and torch.equal(steps[1].z, steps[2].z)


@pytest.mark.parametrize(
    "how, said",
    [
        (dict(solver="rk4"), "euler, heun"),
        (dict(path="ve"), "'flow' or 'ddpm'"),
        (dict(solver="ddim", eta=1.5), "between 0 and 1"),
        (dict(solver="ddim", eta=float("nan")), "between 0 and 1"),
        (dict(solver="heun", eta=0.5), "belongs to the solver ddim"),
        (dict(solver="ddpm"), "generator"),
    ],
)
def test_what_a_solver_refuses(how, said):
    with pytest.raises(ValueError, match=said):
        sample(wavy, schedule_matrix(3, 4), noise(1, 3, 1), **how)


# --- the paper's own objective ---------------------------------------------------------------------------------------


def gaussian_noise(x, time):
    """E[eps | x] on the variance-preserving path at level k = K (1 - time), latent by latent."""
    angle = (1 - time + 0.008) / 1.008 * torch.pi / 2  # as the cosine schedule is usually written
    signal = (torch.cos(angle) / np.cos(0.008 / 1.008 * np.pi / 2)).unsqueeze(-1)  # (B,N,1)
    mean, variance = (y[: x.shape[1], None] for y in (MEAN, VARIANCE.diagonal()))
    return (1 - signal**2).sqrt() * (x - signal * mean) / (signal**2 * variance + 1 - signal**2)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_model_of_noise_lands_there_too(solver):
    denoise = from_noise_prediction(gaussian_noise)
    for kind in ("full", "fss"):
        landed = moments(denoise, schedule_matrix(4, 100, 10, kind=kind), solver=solver, path="ddpm")
        # Not exact, even with Heun: pure noise is read as if a little of it were signal.
        assert_lands(*landed, atol=3e-3, rtol=max(5e-3, most_wrong({"solver": solver})))


def test_a_model_of_noise_is_asked_at_its_own_levels_on_its_own_path():
    seen = []

    def predict(x, time):
        seen.append((x, time))
        return 0.5 * x

    start = noise(1, 2, 3)
    list(sample_steps(from_noise_prediction(predict), schedule_matrix(2, 50, 50), start, path="ddpm"))
    levels = [1000 * (1 - time[0, -1].item()) for _, time in seen]
    assert np.allclose(levels[:50], [980, *range(980, 0, -20)]) and np.allclose(levels[50:], levels[:50])
    assert torch.equal(seen[0][0], start[:, :1]) and (seen[50][1][0, 0] == 1).all()  # unit variance; k = 0 when done

    # A wrong prediction of pure noise moves the first step little: without the floor it would be blown up.
    once = [x for x, _ in seen]
    assert (once[1] - once[0]).abs().max() < 5 * start.abs().max()


# --- causality of the whole sampler ---------------------------------------------------------------------------------


@pytest.mark.parametrize("block_size", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_a_sample_depends_on_noise_of_its_block_and_before_down_to_the_decoded_frame(block_size, kind):
    model = randomise(CausalDiT(replace(TINY, block_size=block_size)))
    vae = randomise(MACVAE(VAEConfig(input_dim=6, latent_dim=3, width=8, depth=1)))
    matrix = schedule_matrix(6, 4, 2, block_size, kind)
    denoise = guided(model, *text(1, 6, 4), *text(1, 6, 2, seed=2), guidance_scale=2.0)
    z = noise(1, 6, 3)
    latents = dependencies(lambda z: sample(denoise, matrix, z), z)
    assert torch.equal(latents, lower_triangle(6, block_size))  # none before, and all after: the control
    frames = dependencies(lambda z: vae.decode(sample(denoise, matrix, z)), z)
    assert not (frames & ~lower_triangle(6, block_size).repeat_interleave(4, dim=0)).any()
    assert frames[-1].all()


def test_words_said_later_do_not_move_earlier_samples():
    model, matrix = randomise(CausalDiT(TINY)), schedule_matrix(6, 4, 2)
    words, mask = text(1, 6, 4)
    mask[:, :4, 2:] = False
    changed = words.clone()
    changed[:, 2:] += 3
    null = text(1, 6, 2, seed=2)
    one, two = (sample(guided(model, w, mask, *null, 3.0), matrix, noise(1, 6, 3)) for w in (words, changed))
    assert torch.equal(one[:, :4], two[:, :4])
    assert ((one - two)[:, 4:].abs().amax(-1) > 1e-6).all()


# --- who moves ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", KINDS)
def test_waiting_and_finished_latents_do_not_move_a_bit_and_the_others_do(kind, solver):
    matrix = schedule_matrix(5, 6, 2, 2, kind)

    def denoise(z_t, t):  # a finished latent says nonsense
        return torch.where(t.unsqueeze(-1) < 1, torch.sin(z_t) + 0.1, torch.nan if solver != "heun" else 7.0)

    steps = list(sample_steps(denoise, matrix, noise(2, 5, 3), solver=solver, generator=seeded(0)))
    assert len(steps) == len(matrix) and [step.row for step in steps] == list(range(len(matrix)))
    for before, after in zip(steps, steps[1:]):
        moves = torch.from_numpy(matrix[after.row] != matrix[before.row])
        assert torch.equal(before.z[:, ~moves], after.z[:, ~moves])
        assert (before.z[:, moves] != after.z[:, moves]).all()
        assert np.array_equal(after.levels, matrix[after.row])
        assert torch.allclose(after.t, torch.from_numpy(1 - matrix[after.row] / 6).expand(2, -1))


def test_the_denoiser_is_called_once_per_row_with_the_times_it_starts_from():
    matrix, seen = schedule_matrix(3, 4, 2), []

    def denoise(z_t, t):
        seen.append(t[0].tolist())
        return torch.zeros_like(z_t)

    out = sample(denoise, matrix, noise(2, 3, 1))
    assert len(seen) == len(matrix) - 1
    for times, levels, after in zip(seen, matrix, matrix[1:]):
        assert np.allclose(times, 1 - levels[: len(times)] / 4)
        assert len(times) == np.flatnonzero(levels != after)[-1] + 1  # what waits behind the last mover is hidden
    assert torch.equal(out, noise(2, 3, 1))


def test_the_true_velocity_of_one_path_leads_to_its_data_and_says_so_on_the_way():
    data, start = noise(1, 4, 2, seed=3), noise(1, 4, 2)
    steps = list(sample_steps(lambda z_t, t: (data - start)[:, : z_t.shape[1]], schedule_matrix(4, 5, 2), start))
    assert torch.allclose(steps[-1].z, data)
    moved = torch.from_numpy(steps[0].levels != steps[1].levels)
    assert steps[0].clean is None and torch.allclose(steps[1].clean[:, moved], data[:, moved])


def test_hiding_the_waiting_latents_changes_nothing_under_a_causal_mask():
    model, matrix, start = randomise(CausalDiT(TINY)), schedule_matrix(6, 5, 2), noise(2, 6, 3)
    words, mask = text(2, 6, 3)
    hidden = sample(guided(model, words, mask, None, None, 1.0), matrix, start)

    def everything(z_t, t):  # put the waiting ones back: their noise, at level K
        full, times = torch.cat([z_t, start[:, z_t.shape[1] :]], 1), torch.zeros(2, 6, dtype=t.dtype)
        times[:, : t.shape[1]] = t
        return model(full, times, words, mask)[:, : z_t.shape[1]]

    torch.testing.assert_close(hidden, sample(everything, matrix, start), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_prefix_stays_and_is_looked_at(solver):
    model, matrix = randomise(CausalDiT(TINY)), schedule_matrix(4, 4, 2)
    denoise = guided(model, *text(1, 6, 3), None, None, 1.0)
    prefix = noise(1, 2, 3, seed=5)
    out = sample(denoise, matrix, noise(1, 4, 3), prefix, solver=solver, generator=seeded(0))
    other = sample(denoise, matrix, noise(1, 4, 3), prefix + 1, solver=solver, generator=seeded(0))
    assert out.shape == (1, 6, 3) and torch.equal(out[:, :2], prefix)
    assert ((out - other)[:, 2:].abs().amax(-1) > 1e-6).all()
    seen = []
    list(sample_steps(lambda z_t, t: seen.append(t) or z_t, matrix, noise(1, 4, 3), prefix))
    assert all((t[:, :2] == 1).all() for t in seen)  # told that the past is clean, at every call


# --- guidance -------------------------------------------------------------------------------------------------------


def test_guidance_is_the_two_branches_extrapolated_in_one_call():
    model = randomise(CausalDiT(TINY))
    words, null = text(2, 4, 5), text(2, 4, 2, seed=2)
    z_t, t = noise(2, 4, 3), torch.rand(2, 4, dtype=torch.float64)
    v_text, v_null = model(z_t, t, *words), model(z_t, t, *null)
    calls = []

    def counted(*args):
        calls.append(len(args[0]))
        return model(*args)

    for scale, batch in ((3.0, 4), (0.5, 4), (1.0, 2), (0.0, 2)):  # one branch where one is enough
        out = guided(counted, *words, *null, scale)(z_t, t)
        assert torch.allclose(out, v_null + scale * (v_text - v_null), rtol=1e-9, atol=1e-12)
        assert calls.pop() == batch and not calls


def test_guidance_keeps_padding_out():
    model = randomise(CausalDiT(replace(TINY, attention="bidirectional")))
    words, null = text(1, 5, 3), text(1, 5, 2, seed=2)
    z_t, t = noise(1, 5, 3), torch.rand(1, 5, dtype=torch.float64)
    valid = torch.tensor([[True, True, True, False, False]])
    padded = guided(model, *words, *null, 3.0, valid)(z_t, t)[:, :3]
    short = guided(model, words[0], words[1][:, :3], null[0], null[1][:, :3], 3.0)(z_t[:, :3], t[:, :3])
    assert torch.allclose(padded, short, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("scale", [float("nan"), float("inf")])
def test_guidance_must_be_a_number(scale):
    with pytest.raises(ValueError, match="finite"):
        guided(None, *text(1, 4, 3), *text(1, 4, 2), scale)


def test_noise_must_fit_the_matrix():
    with pytest.raises(ValueError, match="schedules 4 latents"):
        sample(lambda z_t, t: z_t, schedule_matrix(4, 5), noise(1, 3, 2))
