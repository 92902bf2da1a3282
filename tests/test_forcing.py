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
    t = draw_times(4000, 7, block_size, seeded())
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
    seen = []

    def model(z_t, t, words, word_mask, valid, clock):
        seen.append((t.shape, words, word_mask, valid, clock))
        return z_t

    diffusion_forcing_loss(model, torch.randn(2, 6, 3), "words", "mask", None, block_size=3, clock="clock")
    assert seen == [(torch.Size([2, 6]), "words", "mask", None, "clock")]
