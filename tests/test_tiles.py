"""Tiled triangles: each window of the doubled clip is a moment of FloodDiffusion's triangle, and sees no more."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from minicmdm.config import as_system, preset
from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.diffusion.path import interpolate, velocity
from minicmdm.diffusion.tiles import TICKS, draw_tiles, in_tiles
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import Words
from minicmdm.systems.flood import draw_triangle
from minicmdm.training.batches import DenoiserBatch
from minicmdm.training.denoiser import denoising_loss

B, N, OVERLAP = 3, 11, 4


def scene(attention: str = "window", clock: bool = True):
    """A denoiser with weights that matter, and a padded batch, in float64."""
    torch.manual_seed(0)
    cfg = replace(preset("micro").dit, attention=attention, clock=clock)
    dit = CausalDiT(cfg).double()
    for weight in dit.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(B, N, cfg.latent_dim, generator=generator, dtype=torch.float64)
    words = torch.randn(B, 5, cfg.dim, generator=generator, dtype=torch.float64)
    word_mask = torch.rand(B, N, 5, generator=generator) < 0.7
    valid = torch.arange(N) < torch.tensor([N, 7, 2])[:, None]
    return dit, z, words, word_mask, valid, torch.randint(0, 9, (B, N, 2), generator=generator).double()


@pytest.mark.parametrize("clock", [True, False])
def test_tiled_loss_is_the_loss_of_each_window_in_a_sequence_of_its_own(clock):
    """The dense denoiser, asked window by window with a clean past and a hidden future, gives the same errors."""
    dit, z, words, word_mask, valid, clock = scene(clock=clock)
    t, tile = draw_tiles(valid, OVERLAP, torch.Generator().manual_seed(2))
    t = t.double()
    how = dict(generator=torch.Generator().manual_seed(3), clock=clock, t=t)
    found = diffusion_forcing_loss(in_tiles(dit, z, tile), z, words, word_mask, valid, **how)

    eps = torch.randn(z.shape, generator=torch.Generator().manual_seed(3)).double()
    noisy, total = interpolate(z, eps, t), 0.0
    for window in tile.unique():
        past, inside = tile < window, tile == window
        shown = torch.where(past.unsqueeze(-1), z, noisy)
        v = dit(shown, t.masked_fill(past, 1.0), words, word_mask, valid & (past | inside), clock, past)
        total += (v - velocity(z, eps)).square().mean(-1)[inside & valid].sum()
    assert found.item() == pytest.approx((total / valid.sum()).item(), rel=1e-10)


def test_every_window_is_a_moment_of_the_triangle_and_every_moment_is_drawn():
    """The levels in flight that tiles show a clip are those that `draw_triangle` shows it, each as often."""
    valid = torch.ones(8000, 6, dtype=torch.bool)
    t, tile = draw_tiles(valid, OVERLAP, torch.Generator().manual_seed(0))
    tiles = Counter()
    for times, number in zip(t.tolist(), tile.tolist()):
        for window in set(number):
            tiles[tuple((k, round(times[k], 5)) for k in range(6) if number[k] == window)] += 1
    t, finished, visible = draw_triangle(valid, OVERLAP, torch.Generator().manual_seed(0))
    flying = (visible & ~finished).tolist()
    moments = {
        tuple((k, round(times[k], 5)) for k in range(6) if fly[k]) for times, fly in zip(t.tolist(), flying) if any(fly)
    }
    assert set(tiles) == moments
    assert len(tiles) == TICKS * (OVERLAP + 6 - 1)  # moments from the first latent's start to the last one's end
    share = 8000 / (TICKS * OVERLAP)  # of the clips, each moment; five standard deviations
    assert all(abs(count - share) < 5 * share**0.5 for count in tiles.values())


def test_the_last_stage_trains_on_tiles_of_its_plan(tiny_preset):
    """What `denoising_loss` asks for is the loss of tiles: as wide as the plan's triangle, and with a clean copy."""
    valid = torch.arange(9) < torch.tensor([9, 9, 6, 3])[:, None]
    nobody = torch.zeros(4, 9, dtype=torch.long)
    plan = as_system(tiny_preset, "window")
    torch.manual_seed(0)
    dit = CausalDiT(plan.dit)
    for weight in dit.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    z = torch.randn(4, 9, plan.dit.latent_dim)
    batch = DenoiserBatch(z, valid, ["a"], nobody[:, :1], nobody, torch.zeros(4, 9, 2))
    said = Words(torch.randn(1, 2, plan.dit.text_dim), torch.ones(1, 2, dtype=torch.bool))
    words = SimpleNamespace(encode=lambda _: said)
    read = dit.read(said).embeddings.expand(4, -1, -1)
    everything = torch.ones(4, 9, 2, dtype=torch.bool)
    for overlap in (2, 5):
        own = replace(plan, train=replace(plan.train, overlap=overlap))
        found = denoising_loss(dit, words, batch, own, 0.0, torch.Generator().manual_seed(9))
        luck = torch.Generator().manual_seed(9)
        t, tile = draw_tiles(valid, overlap, luck)
        how = dict(generator=luck, clock=batch.clock, t=t)
        wanted = diffusion_forcing_loss(in_tiles(dit, z, tile), z, read, everything, valid, **how)
        assert found.item() == pytest.approx(wanted.item(), rel=1e-5)


def test_a_past_that_looks_ahead_cannot_be_shared():
    for attention in ("bidirectional", "causal"):
        dit, z, *_ = scene(attention)
        with pytest.raises(ValueError, match=f'must be "window", and this model\'s is {attention!r}'):
            in_tiles(dit, z, torch.zeros(B, N, dtype=torch.long))
