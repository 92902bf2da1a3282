"""Tiled triangles: every window of a clip is taught at once, and all of its latents count.

FloodDiffusion shows one moment of a clip: a clean past, a window of n_s latents in flight, a hidden future. The loss
asks for the window, 4.4 of the 31 latents of a mean toy clip; the rest of the work is context. Here the clip stands in
the sequence twice. The first copy is clean and looks back. The second is cut into windows, each of which holds the
triangle of one moment, sees the clean latents before it and itself, and nothing else:

                 clean 0 1 2 3 4 5   noisy 0 1 | 2 3 4 | 5        n_s = 3, the first begins one latent before the clip
    clean  i     itself and what is before                         no window is looked at
    noisy  i     what is clean before its window      its window

So a latent in flight sees what it sees under the "window" mask (models/dit.py), for all moments of the clip that lie a
whole window apart, at twice the price of one of them. Block diffusion trains so (Arriola et al. 2025), with one level a
block. It needs a past that does not look ahead: under FloodDiffusion's bidirectional mask finished latents see the
window, and no copy of them could serve two windows.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.models.dit import CausalDiT, clock_features

TICKS = 12  # moments between two latents' starts at which training looks, here and in systems/flood.py


def draw_tiles(valid: Tensor, overlap: int, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """Cut each sample into windows of n_s = `overlap` latents and give each the triangle of a moment.

    valid (B,N) -> times (B,N) and the number of each latent's window (B,N). Where the first window begins, up to
    n_s - 1 latents before the clip, and how far its latents have come are drawn for each sample; all of its windows
    share them. Over these draws a latent stands at every place of a window as often as `draw_triangle` puts it there.
    """
    device = generator.device if generator is not None else valid.device
    luck = torch.rand(len(valid), 2, generator=generator, device=device).to(valid.device)
    first, tick = (luck * torch.tensor([overlap, TICKS], device=valid.device)).long().unbind(1)  # (B,) each
    place = torch.arange(valid.shape[1], device=valid.device) + first[:, None]  # (B,N)
    since = TICKS * (overlap - 1 - place % overlap) + tick[:, None]  # (B,N) ticks in flight, of TICKS * n_s
    return since.to(torch.float32) / (TICKS * overlap), place // overlap


def tiled_mask(tile: Tensor, valid: Tensor) -> Tensor:
    """Who sees whom among the 2N latents, clean ones first: tile (B,N), valid (B,N) -> (B,2N,2N) bool."""
    place = torch.arange(tile.shape[1], device=tile.device)
    back = (place[:, None] >= place).expand(len(tile), -1, -1)  # (B,N,N)
    same, before = tile.unsqueeze(2) == tile.unsqueeze(1), tile.unsqueeze(2) > tile.unsqueeze(1)
    clean, noisy = torch.cat([back, torch.zeros_like(back)], 2), torch.cat([before, same], 2)  # (B,N,2N) each
    return torch.cat([clean, noisy], 1) & torch.cat([valid, valid], 1)[:, None]


def in_tiles(dit: CausalDiT, z: Tensor, tile: Tensor) -> Callable[..., Tensor]:
    """A model for `diffusion_forcing_loss`: what `dit` predicts of noisy latents (B,N,C), each in its window.

    z (B,N,C) are the clean ones, tile (B,N) comes from `draw_tiles`. ValueError: another attention than "window".
    """
    if dit.cfg.attention != "window":
        raise ValueError(
            f'tiles teach latents in flight after a past that looks back: attention must be "window", '
            f"and this model's is {dit.cfg.attention!r}"
        )

    def model(
        noisy: Tensor, t: Tensor, words: Tensor, word_mask: Tensor, valid: Tensor, clock: Tensor | None
    ) -> Tensor:
        twice = torch.cat([z, noisy], 1)  # (B,N,C) -> (B,2N,C)
        levels, which = torch.cat([torch.ones_like(t), t], 1).unique(return_inverse=True)  # which (B,2N)
        told = clock_features(t, clock).repeat(1, 2, 1) if dit.cfg.clock else None  # (B,2N,.)
        return dit.evaluate(
            twice,
            which,
            dit.modulations(levels),
            dit.keys_values(words),
            word_mask.repeat(1, 2, 1),
            tiled_mask(tile, valid),
            torch.arange(z.shape[1], device=z.device).repeat(2),
            told,
        )[:, z.shape[1] :]  # (B,2N,C) -> (B,N,C)

    return model
