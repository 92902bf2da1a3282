"""One sampler for every scheduling matrix, and classifier-free guidance (CMDM Alg. 2 as a flow).

The matrix says all there is to say about order: row m gives each latent's noise level, and going to row
m+1 is one call of the denoiser and one Euler step of the latents whose level changes. Full-sequence,
autoregressive and frame-wise (FSS) sampling are the same loop over different matrices.

CMDM's Alg. 2 prints a stochastic DDPM step and, read literally, would also step latents that wait (level
K) or are finished (level 0). The released code takes deterministic Euler steps and leaves those alone,
and so do we.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from minicmdm.diffusion.path import euler_step, level_to_time, velocity_to_data
from minicmdm.diffusion.schedules import check_matrix

Denoise = Callable[[Tensor, Tensor], Tensor]  # (z_t (B,N,C), t (B,N)) -> velocity (B,N,C)


@dataclass
class SampleStep:
    """A moment of sampling, for films and streams: the state after `row` calls."""

    row: int  # 0 is the noise before any call
    levels: np.ndarray  # (N,) noise levels
    z: Tensor  # (B,N,C)
    t: Tensor  # (B,N) flow times of z
    clean: Tensor | None  # (B,N,C) where the call before it thought each latent would end (a latent that still
    # waited was not asked and keeps its noise here); None in row 0


def sample_steps(
    denoise: Denoise, matrix: np.ndarray, noise: Tensor, prefix: Tensor | None = None
) -> Iterator[SampleStep]:
    """Yield the state at every row of the matrix (M,N), starting from noise (B,N,C).

    Latents that wait for their turn are hidden: each call sees the latents up to the last one that moves, and
    nothing after it. Under a causal mask that changes no number and saves half of the work.
    A prefix (B,P,C) of finished latents is put in front: it is at level 0 throughout, never moves, and is
    part of every z that is yielded. For a model with blocks, P should be a multiple of the block size.
    ValueError: the matrix is not a schedule, or its columns are not the noise's latents.
    """
    matrix = check_matrix(matrix)
    num_steps = int(matrix[0, 0])  # K
    if noise.ndim != 3 or noise.shape[1] != matrix.shape[1]:
        raise ValueError(
            f"the matrix schedules {matrix.shape[1]} latents, so noise must be (batch, {matrix.shape[1]}, "
            f"channels), got {tuple(noise.shape)}"
        )
    z = noise
    if prefix is not None:
        z = torch.cat([prefix.to(noise), noise], dim=1)  # (B,P+N,C)
        matrix = np.concatenate([np.zeros((len(matrix), prefix.shape[1]), np.int64), matrix], axis=1)
    levels = torch.from_numpy(matrix).to(z.device)
    times = level_to_time(levels.to(z.dtype), num_steps).unsqueeze(1).expand(-1, len(z), -1)  # (M,B,N)
    yield SampleStep(0, matrix[0], z, times[0], None)
    for row in range(1, len(matrix)):
        # Columns start from left to right, so whatever lies right of the last mover is waiting (or finished).
        seen = int(np.flatnonzero(matrix[row] != matrix[row - 1])[-1]) + 1
        v = denoise(z[:, :seen], times[row - 1][:, :seen])  # (B,seen,C)
        v = torch.cat([v, torch.zeros_like(z[:, seen:])], dim=1)  # (B,N,C)
        clean = velocity_to_data(z, v, times[row - 1])
        z = euler_step(z, v, times[row - 1], times[row])
        yield SampleStep(row, matrix[row], z, times[row], clean)


@torch.no_grad()
def sample(denoise: Denoise, matrix: np.ndarray, noise: Tensor, prefix: Tensor | None = None) -> Tensor:
    """Run the matrix (M,N) to its end: noise (B,N,C) -> clean latents (B,N,C), or (B,P+N,C) with a prefix."""
    for step in sample_steps(denoise, matrix, noise, prefix):  # noqa: B007  the last step is the answer
        pass
    return step.z


def guided(
    model,
    words: Tensor,
    mask: Tensor,
    null_words: Tensor,
    null_mask: Tensor,
    guidance_scale: float,
    valid: Tensor | None = None,
    clock: Tensor | None = None,
) -> Denoise:
    """Bind the text to a model: a denoiser that returns v = v_null + s (v_text - v_null).

    words (B,S,E) and mask (B,N,S) are the sentence's, null_words (B,S',E) and null_mask (B,N,S') those of
    "". valid (B,N) and clock (B,N,2) are the model's own. Both branches run in one batch of 2B. A scale of 1 is the
    plain conditional model, and 0 the unconditional one; each runs one branch. ValueError: a scale that is not a
    finite number.
    """
    if not np.isfinite(guidance_scale):
        raise ValueError(f"guidance_scale must be a finite number, got {guidance_scale!r}")

    def one(words: Tensor, mask: Tensor, times: int = 1) -> Denoise:
        more = [None if x is None else torch.cat([x] * times) for x in (valid, clock)]

        def denoise(z_t: Tensor, t: Tensor) -> Tensor:
            seen = z_t.shape[1]  # a call may hide the latents at the end
            return model(z_t, t, words, mask[:, :seen], *(None if x is None else x[:, :seen] for x in more))

        return denoise

    if guidance_scale == 1:
        return one(words, mask)
    if guidance_scale == 0:
        return one(null_words, null_mask)

    # Pad the shorter sentence with words nobody sees, so that both fit in one batch.
    length = max(words.shape[1], null_words.shape[1])
    both_words = torch.cat([_pad(words, length, axis=1), _pad(null_words, length, axis=1)])  # (2B,S,E)
    both_masks = torch.cat([_pad(mask, length, axis=2), _pad(null_mask, length, axis=2)])  # (2B,N,S)
    both = one(both_words, both_masks, times=2)

    def denoise(z_t: Tensor, t: Tensor) -> Tensor:
        v_text, v_null = both(torch.cat([z_t, z_t]), torch.cat([t, t])).chunk(2)  # 2 x (B,N,C)
        return v_null + guidance_scale * (v_text - v_null)

    return denoise


def _pad(x: Tensor, length: int, axis: int) -> Tensor:
    shape = list(x.shape)
    shape[axis] = length - x.shape[axis]
    return torch.cat([x, x.new_zeros(shape)], dim=axis)
