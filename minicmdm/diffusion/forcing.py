"""Diffusion forcing: train the denoiser with an independent noise level per latent (CMDM Alg. 1).

Full-sequence diffusion noises a whole clip to one level, so a sampler must denoise it in step. Here every
latent (or block of latents) draws its own, and the denoiser learns each mixture of clean, half-noisy and
noisy that any scheduling matrix can present.
"""

import torch
from torch import Tensor

from minicmdm.diffusion.path import interpolate, velocity

STEEPEST = 0.15  # flow time per block: between full-sequence (0) and a little steeper than FSS at L = 2, K = 20 (0.1)
AFTER = 10  # how many blocks past the last one a staircase's front may be: the end of a sampling run


def draw_times(
    batch: int,
    num_latents: int,
    block_size: int,
    generator: torch.Generator | None = None,
    staircase: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Flow times (B,N) in [0,1], one per block of latents, and which of them are asked (B,N) bool.

    The paper's levels are independent and uniform (`staircase=0`), and every latent is asked. A sampler, however,
    never meets a past noisier than the present: its levels fall along the sequence. With `staircase` > 0 that share
    of the batches gets such levels. The batch shares its front, the last block that has started; each sample has a
    slope of its own, and levels are cut off at 0 (waiting) and 1 (finished). Asked are then the latents that a sampler
    would move: those in flight and the next to start.
    """
    device = generator.device if generator is not None else None
    num_blocks = -(-num_latents // block_size)
    t = torch.rand(batch, num_blocks, generator=generator, device=device)  # (B,blocks)
    asked = torch.ones_like(t, dtype=torch.bool)
    if staircase > 0:
        chosen, place = torch.rand(2, generator=generator, device=device)
        slope = STEEPEST * torch.rand(batch, 1, generator=generator, device=device)  # (B,1)
        if chosen < staircase:
            front = (place * (num_blocks + AFTER)).floor()
            line = slope * (
                front - torch.arange(num_blocks, device=device) + t[:, :1]
            )  # (B,blocks), falls to the right
            asked = (line < 1) & (line > -slope)
            t = line.clamp(0, 1)
    return tuple(x.repeat_interleave(block_size, dim=1)[:, :num_latents] for x in (t, asked))  # 2 x (B,N)


def diffusion_forcing_loss(
    model,
    z: Tensor,
    words: Tensor,
    word_mask: Tensor,
    valid: Tensor | None = None,
    block_size: int = 1,
    generator: torch.Generator | None = None,
    staircase: float = 0.0,
) -> Tensor:
    """The velocity's mean squared error over valid latents (CMDM Eq. 7 in its released, flow form). Scalar.

    z (B,N,C) are normalised clean latents; words (B,S,E), word_mask (B,N,S) and valid (B,N) go to `model`
    as they are. Text drop is the caller's: it replaces a sample's sentence by "" before encoding, which
    keeps the words, the per-latent mask and the null branch of guidance one and the same thing. `staircase` is
    the share of batches with levels that fall along the sequence; their finished and waiting latents are not asked.
    """
    batch, num_latents, _ = z.shape
    device = generator.device if generator is not None else z.device
    t, asked = draw_times(batch, num_latents, block_size, generator, staircase)
    eps = torch.randn(z.shape, generator=generator, device=device).to(z)
    # What waits behind the last one asked is hidden, as in sampling: no call pays for it.
    columns = asked.any(0).nonzero()
    seen = int(columns.max()) + 1 if len(columns) else num_latents  # none: the whole batch is finished
    z, eps, t, asked = z[:, :seen], eps[:, :seen], t[:, :seen].to(z), asked[:, :seen].to(z.device)
    word_mask, valid = (x if x is None else x[:, :seen] for x in (word_mask, valid))
    predicted = model(interpolate(z, eps, t), t, words, word_mask, valid)
    error = (predicted - velocity(z, eps)).square().mean(-1)  # (B,seen,C) -> (B,seen)
    if valid is not None:
        asked = asked & valid
    # `where` rather than a product: whatever stands in the padding, even NaN, stays out.
    return torch.where(asked, error, 0).sum() / asked.sum().clamp_min(1)
