"""Diffusion forcing: train the denoiser with an independent noise level per latent (CMDM Alg. 1).

Full-sequence diffusion noises a whole clip to one level, so a sampler must denoise it in step. Here every
latent (or block of latents) draws its own, and the denoiser learns each mixture of clean, half-noisy and
noisy that any scheduling matrix can present.
"""

import torch
from torch import Tensor

from minicmdm.diffusion.path import DDPM_LEVELS, cosine_alpha_bar, interpolate, velocity

LEVELS = 64  # different times in one batch


def draw_times(
    batch: int, num_latents: int, block_size: int, generator: torch.Generator | None = None, power: float = 1.0
) -> Tensor:
    """Flow times (B,N) = u ** power, u uniform on [0,1), one draw per block of latents, on the generator's device.

    A power of 1 is the paper's uniform choice. More draws noisy latents more often: there it is decided what will
    happen, and near the data only how exactly. One batch uses LEVELS different u, evenly spaced from a random first
    one: each is uniform all the same, and the denoiser computes its modulation once a level rather than once a latent.
    """
    device = generator.device if generator is not None else None
    num_blocks = -(-num_latents // block_size)
    level = torch.randint(LEVELS, (batch, num_blocks), generator=generator, device=device)  # (B,blocks)
    t = ((level + torch.rand((), generator=generator, device=device)) / LEVELS) ** power
    return t.repeat_interleave(block_size, dim=1)[:, :num_latents]  # (B,N)


def draw_boundary(
    valid: Tensor, block_size: int = 1, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """For training the "window" mask: draw where the committed past ends and where the visible future ends.

    valid (B,N) -> committed and visible, (B,N) bool each, both cut between blocks. A quarter of the samples have no
    past, as a motion has at its start, and the others any; half of the samples show all that is left, and the others
    any part of it, since a sampler hides what still waits. At least one block is in flight.
    """
    past, blocks, luck = _draw_past(valid, block_size, generator)
    shown = past + 1 + (luck[:, 1] * (blocks - past)).long().clamp(max=blocks - past - 1)  # (B,), past+1 .. blocks
    shown = torch.where(luck[:, 2] < 0.5, blocks, shown)
    block = torch.arange(valid.shape[1], device=valid.device) // block_size  # (N,)
    return valid & (block < past[:, None]), valid & (block < shown[:, None])


def draw_staircase(
    valid: Tensor, block_size: int = 1, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Levels as FSS presents them: finished latents, a staircase of times falling to 0, and the rest hidden.

    valid (B,N) -> times (B,N), committed and visible (B,N) bool. Each sample draws the height L/K of its steps, from a
    twentieth to all of the way (autoregressive), its past, and how far its first latent in flight has come.
    """
    past, _, luck = _draw_past(valid, block_size, generator)
    height = 0.05 ** luck[:, 1]  # (B,), as many between .05 and .22 as between .22 and 1
    front = luck[:, 2] * torch.where(past > 0, height, 1.0)  # what the first one in flight still has to go
    block = torch.arange(valid.shape[1], device=valid.device) // block_size  # (N,)
    t = 1 - front[:, None] - (block - past[:, None]) * height[:, None]  # (B,N)
    committed, visible = valid & (block < past[:, None]), valid & (t > 0)
    t = (t.clamp(0, 1) * LEVELS).floor() / LEVELS  # few different ones, see `draw_times`
    return t.masked_fill(committed, 1.0), committed, visible


def _draw_past(valid: Tensor, block_size: int, generator) -> tuple[Tensor, Tensor, Tensor]:
    """How many blocks are finished (B,), how many there are (B,), and luck (B,3), of which the first is used up."""
    device = generator.device if generator is not None else valid.device
    luck = torch.rand(len(valid), 3, generator=generator, device=device).to(valid.device)
    blocks = -(-valid.sum(1) // block_size)  # (B,)
    past = ((luck[:, 0] * 4 - 1).clamp(min=0) / 3 * blocks).long().clamp(max=blocks - 1)  # (B,), 0 .. blocks-1
    return past, blocks, luck


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
    target: str = "v",
    committed: Tensor | None = None,
    t: Tensor | None = None,
) -> Tensor:
    """The prediction's mean squared error over valid latents (CMDM Eq. 10, Alg. 1). Scalar.

    z (B,N,C) are normalised clean latents; words (B,S,E), word_mask (B,N,S), valid (B,N) and clock (B,N,2) go to
    `model` as they are. Text drop is the caller's: it replaces a sample's sentence by "" before encoding, which
    keeps the words, the per-latent mask and the null branch of guidance one and the same thing.
    path: "flow" asks for the velocity at t, as the release does (or, by `target`, for x0 or eps); "ddpm" for the noise
    at integer levels k of 0..1000, as the paper writes, and tells the model 1 - k/1000.
    committed (B,N): latents that are finished (`draw_boundary`, `draw_staircase`). They are given clean, the model
    hears of them, and they do not count. t (B,N): the times, drawn independently unless given.
    """
    batch, num_latents, _ = z.shape
    t = (draw_times(batch, num_latents, block_size, generator) if t is None else t).to(z)
    device = generator.device if generator is not None else z.device
    eps = torch.randn(z.shape, generator=generator, device=device).to(z)
    asked, more = valid, {}
    if committed is not None:
        t = t.masked_fill(committed, 1.0)
        asked, more = ~committed if valid is None else valid & ~committed, {"committed": committed}
    if path == "flow":
        noisy, wanted = interpolate(z, eps, t), {"v": velocity(z, eps), "x0": z, "eps": eps}[target]
    elif path == "ddpm":
        level = ((1 - t) * (DDPM_LEVELS + 1)).ceil() - 1  # uniform on 0..K for t uniform on [0,1); 1 - k/K is t again
        level = level.clamp_min(0)  # the finished ones, t = 1
        t = 1 - level / DDPM_LEVELS
        alpha_bar = cosine_alpha_bar(level / DDPM_LEVELS).unsqueeze(-1)  # (B,N,1)
        noisy, wanted = alpha_bar.sqrt() * z + (1 - alpha_bar).sqrt() * eps, eps
    else:
        raise ValueError(f"unknown path {path!r}: expected 'flow' or 'ddpm'")
    predicted = model(noisy, t, words, word_mask, valid, clock, **more)
    error = (predicted - wanted).square().mean(-1)  # (B,N,C) -> (B,N)
    if asked is None:
        return error.mean()
    # `where` rather than a product: whatever stands in the padding, even NaN, stays out.
    return torch.where(asked, error, 0).sum() / asked.sum().clamp_min(1)
