"""Diffusion forcing: train the denoiser with an independent noise level per latent (CMDM Alg. 1).

Full-sequence diffusion noises a whole clip to one level, so a sampler must denoise it in step. Here every
latent (or block of latents) draws its own, and the denoiser learns each mixture of clean, half-noisy and
noisy that any scheduling matrix can present.
"""

import torch
from torch import Tensor

from minicmdm.diffusion.path import DDPM_LEVELS, cosine_alpha_bar, interpolate, velocity

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
    path: str = "flow",
    committed: Tensor | None = None,
) -> Tensor:
    """The prediction's mean squared error over valid latents (CMDM Eq. 10, Alg. 1). Scalar.

    z (B,N,C) are normalised clean latents; words (B,S,E), word_mask (B,N,S), valid (B,N) and clock (B,N,2) go to
    `model` as they are. Text drop is the caller's: it replaces a sample's sentence by "" before encoding, which
    keeps the words, the per-latent mask and the null branch of guidance one and the same thing.
    path: "flow" asks for the velocity at t, as the release does; "ddpm" for the noise at integer levels k of 0..1000,
    as the paper writes, and tells the model 1 - k/1000.
    committed (B,N): latents that are finished, for window attention (models/dit.py `draw_boundary`). They are given
    clean, the model hears of them, and they do not count.
    """
    batch, num_latents, _ = z.shape
    t = draw_times(batch, num_latents, block_size, generator).to(z)
    device = generator.device if generator is not None else z.device
    eps = torch.randn(z.shape, generator=generator, device=device).to(z)
    asked, more = valid, {}
    if committed is not None:
        t = t.masked_fill(committed, 1.0)
        asked, more = ~committed if valid is None else valid & ~committed, {"committed": committed}
    if path == "flow":
        noisy, target = interpolate(z, eps, t), velocity(z, eps)
    elif path == "ddpm":
        level = ((1 - t) * (DDPM_LEVELS + 1)).ceil() - 1  # uniform on 0..K for t uniform on [0,1); 1 - k/K is t again
        level = level.clamp_min(0)  # the finished ones, t = 1
        t = 1 - level / DDPM_LEVELS
        alpha_bar = cosine_alpha_bar(level / DDPM_LEVELS).unsqueeze(-1)  # (B,N,1)
        noisy, target = alpha_bar.sqrt() * z + (1 - alpha_bar).sqrt() * eps, eps
    else:
        raise ValueError(f"unknown path {path!r}: expected 'flow' or 'ddpm'")
    predicted = model(noisy, t, words, word_mask, valid, clock, **more)
    error = (predicted - target).square().mean(-1)  # (B,N,C) -> (B,N)
    if asked is None:
        return error.mean()
    # `where` rather than a product: whatever stands in the padding, even NaN, stays out.
    return torch.where(asked, error, 0).sum() / asked.sum().clamp_min(1)
