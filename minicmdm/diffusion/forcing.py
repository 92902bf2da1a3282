"""Diffusion forcing: train the denoiser with an independent noise level per latent (CMDM Alg. 1).

Full-sequence diffusion noises a whole clip to one level, so a sampler must denoise it in step. Here every
latent (or block of latents) draws its own, and the denoiser learns each mixture of clean, half-noisy and
noisy that any scheduling matrix can present.
"""

import torch
from torch import Tensor

from minicmdm.diffusion.path import interpolate, velocity

LEVELS = 64  # different times in one batch


def draw_times(batch: int, num_latents: int, block_size: int, generator: torch.Generator | None = None) -> Tensor:
    """Flow times (B,N), uniform on [0,1), one draw per block of latents, on the generator's device.

    One batch uses LEVELS different times, evenly spaced from a random first one: each draw is uniform on [0,1) all the
    same, and the denoiser computes its modulation once a level rather than once a latent.
    """
    device = generator.device if generator is not None else None
    num_blocks = -(-num_latents // block_size)
    level = torch.randint(LEVELS, (batch, num_blocks), generator=generator, device=device)  # (B,blocks)
    t = (level + torch.rand((), generator=generator, device=device)) / LEVELS
    return t.repeat_interleave(block_size, dim=1)[:, :num_latents]  # (B,N)


def diffusion_forcing_loss(
    model,
    z: Tensor,
    words: Tensor,
    word_mask: Tensor,
    valid: Tensor | None = None,
    block_size: int = 1,
    generator: torch.Generator | None = None,
    clock: Tensor | None = None,
) -> Tensor:
    """The velocity's mean squared error over valid latents (CMDM Eq. 7 in its released, flow form). Scalar.

    z (B,N,C) are normalised clean latents; words (B,S,E), word_mask (B,N,S), valid (B,N) and clock (B,N,2) go to
    `model` as they are. Text drop is the caller's: it replaces a sample's sentence by "" before encoding, which
    keeps the words, the per-latent mask and the null branch of guidance one and the same thing.
    """
    batch, num_latents, _ = z.shape
    t = draw_times(batch, num_latents, block_size, generator).to(z)
    device = generator.device if generator is not None else z.device
    eps = torch.randn(z.shape, generator=generator, device=device).to(z)
    predicted = model(interpolate(z, eps, t), t, words, word_mask, valid, clock)
    error = (predicted - velocity(z, eps)).square().mean(-1)  # (B,N,C) -> (B,N)
    if valid is None:
        return error.mean()
    # `where` rather than a product: whatever stands in the padding, even NaN, stays out.
    return torch.where(valid, error, 0).sum() / valid.sum().clamp_min(1)
