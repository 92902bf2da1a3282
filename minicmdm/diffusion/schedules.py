"""Which latent is at which noise level at each moment of sampling: the scheduling matrix and what it costs.

A row is a moment, a column is a latent; going from one row to the next is one call of the denoiser. Blocks of
`block_size` latents share a level, and each block starts L steps after the block before it:

    level[m, block] = clip(K + L * block - m, 0, K)

`num_steps` K is how many steps each latent takes from noise (K) to clean (0); `uncertainty` L is the stagger.
L = 0 moves everything together (full-sequence diffusion), L = K starts a block when the one before it is
finished (autoregressive), and the paper's frame-wise sampling schedule (FSS) is what lies between.

CMDM Eq. 13 prints FSS rows K, K-L, K-2L, ... and omits the steps between. It can be read two ways: latents
jump by L (K/L + N - 1 calls), or they take unit steps and are L steps apart (K + L (N - 1) calls). The
sentence beneath it (the next frame starts when the current one is at K - L) and the released code take the
second, and so do we: L is a stagger, not a step size. For K = 4, L = 2 and three latents:

    4 4 4 | 3 4 4 | 2 4 4 | 1 3 4 | 0 2 4 | 0 1 3 | 0 0 2 | 0 0 1 | 0 0 0
"""

from dataclasses import dataclass

import numpy as np

KINDS = ("full", "autoregressive", "fss")


def schedule_matrix(
    num_latents: int, num_steps: int, uncertainty: int = 2, block_size: int = 1, kind: str = "fss"
) -> np.ndarray:
    """The noise levels (M,N), int64, with M = K + L (ceil(N / block_size) - 1) + 1 rows (CMDM Eq. 13).

    `uncertainty` is read by "fss" alone: "full" is L = 0 and "autoregressive" is L = K by definition.
    ValueError: an unknown kind, a count below 1, an uncertainty outside 0..num_steps, or a non-integer.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown schedule {kind!r}: expected one of {', '.join(KINDS)}")
    num_latents = _integer("num_latents", num_latents, low=1)
    num_steps = _integer("num_steps", num_steps, low=1)
    block_size = _integer("block_size", block_size, low=1)
    if kind == "full":
        stagger = 0
    elif kind == "autoregressive":
        stagger = num_steps
    else:
        stagger = _integer("uncertainty", uncertainty, low=0)
        if stagger > num_steps:
            raise ValueError(
                f"uncertainty must be at most num_steps ({num_steps}), got {stagger}: "
                "a block would still wait after the one before it is finished"
            )
    num_blocks = -(-num_latents // block_size)  # ceil(N / b)
    rows = num_steps + stagger * (num_blocks - 1) + 1
    row, block = np.arange(rows)[:, None], np.arange(num_blocks)[None, :]
    levels = np.clip(num_steps + stagger * block - row, 0, num_steps)  # (M, blocks)
    return np.repeat(levels, block_size, axis=1)[:, :num_latents].astype(np.int64)  # (M,N)


@dataclass(frozen=True)
class ScheduleCost:
    """What a scheduling matrix costs, counted on the matrix itself."""

    rows: int  # M
    calls: int  # denoiser calls, M - 1; guidance doubles the batch of a call, not their number
    latents_in_flight: int  # the most moved by one call: min(N, block_size * ceil(K / L)), or N when L = 0
    calls_to_first: int  # calls until the first latent is clean: K
    calls_per_further: float  # calls between one finished block and the next: L (0 if all finish together)


def cost(matrix: np.ndarray) -> ScheduleCost:
    """Count rows, calls and latents in flight of a scheduling matrix (M,N). ValueError: not a valid one."""
    matrix = check_matrix(matrix)
    moving = matrix[1:] < matrix[:-1]  # (M-1,N): which latents each call moves
    finished_at = np.unique((matrix > 0).sum(axis=0))  # calls until each latent is clean, each value once
    gaps = np.diff(finished_at)
    return ScheduleCost(
        rows=len(matrix),
        calls=len(matrix) - 1,
        latents_in_flight=int(moving.sum(axis=1).max()),
        calls_to_first=int(finished_at[0]),
        calls_per_further=float(gaps.mean()) if len(gaps) else 0.0,
    )


def check_matrix(matrix: np.ndarray) -> np.ndarray:
    """The matrix as int64 (M,N), if every column starts at the same K >= 1, never rises and ends at 0."""
    levels = np.asarray(matrix)
    if levels.ndim != 2 or levels.shape[0] < 2 or levels.shape[1] < 1 or levels.dtype.kind not in "iu":
        raise ValueError(
            f"a scheduling matrix is integers (rows >= 2, latents >= 1), got {levels.shape} of {levels.dtype}"
        )
    levels = levels.astype(np.int64)
    if levels[0].min() != levels[0].max() or levels[0, 0] < 1:
        raise ValueError(f"every latent must start at the same level K >= 1, got {levels[0].tolist()}")
    if levels[-1].any():
        raise ValueError(f"every latent must end clean (level 0), got {levels[-1].tolist()}")
    if (np.diff(levels, axis=0) > 0).any():
        row, latent = np.argwhere(np.diff(levels, axis=0) > 0)[0]
        raise ValueError(f"a noise level may never rise, but latent {latent} rises after row {row}")
    return levels


def _integer(name: str, value, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {value!r}")
    return int(value)
