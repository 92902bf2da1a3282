"""Tiled triangles: each window of the doubled clip is a moment of FloodDiffusion's triangle, and sees no more."""

from dataclasses import replace

import pytest
import torch

from minicmdm.config import preset
from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.diffusion.path import interpolate, velocity
from minicmdm.diffusion.tiles import draw_tiles, in_tiles, tiled_mask
from minicmdm.models.dit import CausalDiT
from minicmdm.systems.flood import draw_triangle

B, N, OVERLAP = 3, 11, 4


def scene(attention: str = "window"):
    """A denoiser with weights that matter, and a padded batch, in float64."""
    torch.manual_seed(0)
    cfg = replace(preset("micro").dit, attention=attention)
    dit = CausalDiT(cfg).double()
    for weight in dit.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(B, N, cfg.latent_dim, generator=generator, dtype=torch.float64)
    words = torch.randn(B, 5, cfg.dim, generator=generator, dtype=torch.float64)
    word_mask = torch.rand(B, N, 5, generator=generator) < 0.7
    valid = torch.arange(N) < torch.tensor([N, 7, 2])[:, None]
    clock = torch.randint(0, 9, (B, N, 2), generator=generator).double()
    return dit, z, words, word_mask, valid, clock


def tiled_loss(dit, z, words, word_mask, valid, clock, t, tile):
    """The loss of seed 3's noise."""
    generator = torch.Generator().manual_seed(3)
    model = in_tiles(dit, z, tile)
    return diffusion_forcing_loss(model, z, words, word_mask, valid, generator=generator, clock=clock, t=t)


@pytest.mark.parametrize("attention", ["window", "causal"])
def test_tiled_loss_is_the_loss_of_each_window_in_a_sequence_of_its_own(attention):
    """The dense denoiser, asked window by window with a clean past and a hidden future, gives the same errors."""
    dit, z, words, word_mask, valid, clock = scene(attention)
    t, tile = draw_tiles(valid, OVERLAP, torch.Generator().manual_seed(2))
    t = t.double()
    found = tiled_loss(dit, z, words, word_mask, valid, clock, t, tile)

    eps = torch.randn(z.shape, generator=torch.Generator().manual_seed(3)).double()
    noisy, total = interpolate(z, eps, t), 0.0
    for window in tile.unique():
        past, inside = tile < window, tile == window
        shown = torch.where(past.unsqueeze(-1), z, noisy)
        seen = valid & (past | inside)
        v = dit(shown, t.masked_fill(past, 1.0), words, word_mask, seen, clock, past)
        total += (v - velocity(z, eps)).square().mean(-1)[inside & valid].sum()
    assert found.item() == pytest.approx((total / valid.sum()).item(), rel=1e-10)


def test_every_window_is_a_moment_of_the_triangle_and_every_moment_is_drawn():
    """The levels in flight that tiles show a clip are those that `draw_triangle` shows it, no more and no fewer."""
    valid = torch.ones(4000, 6, dtype=torch.bool)
    t, tile = draw_tiles(valid, OVERLAP, torch.Generator().manual_seed(0))
    tiles = set()
    for times, number in zip(t.tolist(), tile.tolist()):
        for window in set(number):
            tiles.add(tuple((k, round(times[k], 5)) for k in range(6) if number[k] == window))
    t, finished, visible = draw_triangle(valid, OVERLAP, torch.Generator().manual_seed(0))
    flying = (visible & ~finished).tolist()
    moments = {
        tuple((k, round(times[k], 5)) for k in range(6) if fly[k]) for times, fly in zip(t.tolist(), flying) if any(fly)
    }
    assert tiles == moments
    assert len(tiles) == 12 * (OVERLAP + 6 - 1)  # TICKS moments from one latent's start to the next


def test_every_latent_counts_once():
    """The mean over a clip is over all of its latents: a triangle asks for those in flight only."""
    dit, z, words, word_mask, valid, clock = scene()
    t, tile = draw_tiles(valid, OVERLAP, torch.Generator().manual_seed(2))
    for weight in (dit.out.weight, dit.out.bias):
        torch.nn.init.zeros_(weight)  # predicts 0, so the loss is the mean square of the velocities
    loss = tiled_loss(dit, z, words, word_mask, valid, clock, t.double(), tile)
    eps = torch.randn(z.shape, generator=torch.Generator().manual_seed(3)).double()
    assert loss.item() == pytest.approx(velocity(z, eps)[valid].square().mean().item(), rel=1e-12)


def test_a_past_that_looks_ahead_cannot_be_shared():
    with pytest.raises(ValueError, match='tiles need finished latents that do not look ahead.*"window"'):
        tiled_mask(torch.zeros(1, 4, dtype=torch.long), torch.ones(1, 4, dtype=torch.bool), "bidirectional")
