"""The sampler: right on Gaussians for every schedule, causal from noise to decoded frame, and still when told."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.config import DiTConfig, VAEConfig
from minicmdm.diffusion.sampling import guided, sample, sample_steps
from minicmdm.diffusion.schedules import KINDS, schedule_matrix
from minicmdm.models.dit import CausalDiT
from minicmdm.models.vae import MACVAE

TINY = DiTConfig(latent_dim=3, text_dim=5, dim=16, layers=2, heads=2, time_dim=8)


def noise(batch, latents, channels, seed=0):
    return torch.randn(batch, latents, channels, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def text(batch, latents, words, seed=1):
    return noise(batch, words, 5, seed), torch.ones(batch, latents, words, dtype=torch.bool)


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


def moments(denoise, matrix):
    """The sampler is affine in its noise here, so its mean and covariance are exact: no sampling error."""
    points = torch.cat([torch.zeros(1, 4, 1), torch.eye(4).unsqueeze(-1)]).double()
    out = sample(denoise, matrix, points)[..., 0]
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


@pytest.mark.parametrize("kind", KINDS)
def test_waiting_and_finished_latents_do_not_move_a_bit_and_the_others_do(kind):
    matrix = schedule_matrix(5, 6, 2, 2, kind)
    steps = list(sample_steps(lambda z_t, t: torch.sin(z_t) + 0.1, matrix, noise(2, 5, 3)))
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


def test_a_prefix_stays_and_is_looked_at():
    model, matrix = randomise(CausalDiT(TINY)), schedule_matrix(4, 4, 2)
    denoise = guided(model, *text(1, 6, 3), None, None, 1.0)
    prefix = noise(1, 2, 3, seed=5)
    out = sample(denoise, matrix, noise(1, 4, 3), prefix)
    other = sample(denoise, matrix, noise(1, 4, 3), prefix + 1)
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
