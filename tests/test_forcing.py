"""Diffusion forcing: independent levels, the right target, and padding that cannot leak in."""

import math

import pytest
import torch

from minicmdm.diffusion.forcing import diffusion_forcing_loss, draw_times
from minicmdm.diffusion.path import data_to_velocity


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("block_size", [1, 3])
def test_times_are_uniform_equal_in_a_block_and_independent_between_blocks(block_size):
    t, asked = draw_times(4000, 7, block_size, seeded())
    assert asked.all()
    assert t.shape == (4000, 7) and t.min() >= 0 and t.max() < 1
    assert torch.allclose(t.mean(0), torch.tensor(0.5), atol=0.02)
    assert torch.allclose(t.var(0), torch.tensor(1 / 12), atol=0.005)
    together = torch.corrcoef(t.T)
    same_block = (torch.arange(7) // block_size)[:, None] == torch.arange(7) // block_size
    assert (together[same_block] > 0.999).all() and (together[~same_block].abs() < 0.08).all()


def test_a_model_that_knows_the_data_has_no_loss_and_a_silent_one_pays_the_target():
    torch.manual_seed(0)
    z = 2 * torch.randn(64, 16, 4, dtype=torch.float64)
    knows = diffusion_forcing_loss(lambda z_t, t, *_: data_to_velocity(z_t, z, t), z, None, None, generator=seeded())
    silent = diffusion_forcing_loss(lambda z_t, *_: torch.zeros_like(z_t), z, None, None, generator=seeded())
    assert knows < 1e-9
    assert math.isclose(silent, 4 + 1, rel_tol=0.1)  # E |z - eps|^2 = Var z + Var eps


def test_padding_cannot_leak_in():
    torch.manual_seed(0)
    z = torch.randn(2, 6, 3)
    valid = torch.ones(2, 6, dtype=torch.bool)
    valid[0, 4:] = False

    def loss(z):
        return diffusion_forcing_loss(lambda z_t, *_: 0.3 * z_t, z, None, None, valid, generator=seeded())

    broken = z.clone().requires_grad_()
    with torch.no_grad():
        broken[0, 4:] = torch.nan
    assert torch.equal(loss(z), loss(broken))

    def per_latent(z_t, *_):  # an error of exactly n at latent n, wherever its target is
        return z_t * 0

    flat = diffusion_forcing_loss(per_latent, torch.zeros(2, 6, 3), None, None, valid, generator=seeded())
    draw_times(2, 6, 1, g := seeded())
    eps = torch.randn(2, 6, 3, generator=g)
    assert torch.allclose(flat, eps[valid].square().mean())  # a mean over valid latents, not over all


def test_the_seed_decides():
    z = torch.randn(2, 6, 3)
    losses = [diffusion_forcing_loss(lambda z_t, *_: z_t, z, None, None, generator=seeded(s)) for s in (1, 1, 2)]
    assert losses[0] == losses[1] != losses[2]


def test_the_model_receives_text_and_mask_as_they_are():
    seen, mask = [], torch.rand(2, 6, 5) < 0.5

    def model(z_t, t, words, word_mask, valid):
        seen.append((t.shape, words, word_mask, valid))
        return z_t

    diffusion_forcing_loss(model, torch.randn(2, 6, 3), "words", mask, None, block_size=3)
    ((shape, words, word_mask, valid),) = seen
    assert (shape, words, valid) == (torch.Size([2, 6]), "words", None) and torch.equal(word_mask, mask)


@pytest.mark.parametrize("block_size", [1, 3])
def test_a_staircase_never_has_a_past_noisier_than_the_present(block_size):
    generator, falling, steps = seeded(), 0, []
    for _ in range(300):
        t, asked = draw_times(8, 12, block_size, generator, staircase=0.5)
        assert t.min() >= 0 and t.max() <= 1
        if (t.diff(dim=1) <= 1e-6).all():
            falling += 1
            assert asked[(t > 0) & (t < 1)].all() and not asked[t == 1].any()
            assert ((t == 0) & asked).sum(1).max() <= block_size  # at most the one block that starts next
            blocks = t[:, ::block_size]
            inner = (blocks[:, :-1] < 1) & (blocks[:, 1:] > 0)
            steps.append(-blocks.diff(dim=1)[inner])
    steps = torch.cat(steps)
    assert 120 < falling < 180
    assert steps.max() <= 0.15 + 1e-6 and steps.min() < 0.01  # from full-sequence to steeper than FSS


def test_only_what_a_sampler_would_move_is_asked_and_what_waits_is_hidden():
    z = torch.randn(8, 12, 3, dtype=torch.float64)
    calls = []

    def model(z_t, t, *_):
        calls.append((z_t.detach(), t))
        return torch.where((t == 1)[..., None], torch.full_like(z_t, 1e6), torch.zeros_like(z_t))

    for seed in range(40):
        loss = diffusion_forcing_loss(model, z, None, None, generator=seeded(seed), staircase=1.0)
        assert loss < 10  # the wild answers at finished latents cost nothing
    for z_t, t in calls:
        assert torch.equal(z_t[t == 1], z[:, : t.shape[1]][t == 1])
        assert (t == 0).sum(1).max() <= 1  # hidden: nobody sees a second waiting latent
    assert any((t == 1).any() for _, t in calls) and len({t.shape[1] for _, t in calls}) > 5
