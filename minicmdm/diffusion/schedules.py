"""Which latent is at which noise level at each moment of sampling: the scheduling matrix and what it costs.

A row is a moment, a column is a latent; going from one row to the next is one call of the denoiser. Blocks of
`block_size` latents share a level. `num_steps` K is how many steps each takes from noise (K) to clean (0). Schedules
differ only in how many calls a block waits before it starts:

    level[m, block] = clip(K + wait[block] - m, 0, K)

    full            wait = 0                                all together, as in ordinary diffusion
    autoregressive  wait = K * block                        one block after the other
    fss             wait = L * block                        the paper's frame-wise sampling; L is `uncertainty`, 0..K
    triangular      wait = floor(K * block / n_s)           FloodDiffusion's (Eq. 19); n_s is `overlap`, 1..K
    trapezoid       wait = L * min(block, B - 1 - block)    both ends first, the middle last, for B blocks

FSS and the triangle are one schedule under two names whenever L n_s = K: 50 steps with L = 2 are n_s = 25, Flood's 10
steps with n_s = 5 are L = 2. FSS fixes how far apart blocks start, and ceil(K / L) of them or fewer are in flight; the
triangle fixes that n_s are in flight. They differ when n_s does not divide K (Flood's code refuses that; here blocks
start floor or ceil of K / n_s calls apart). Flood's clock also runs on to 1 + N / n_s (Eq. 22), though the last
latent is clean at 1 + (N - 1) / n_s, and with the ceilings of Eqs 23-24 each latent takes its steps one too late,
missing the first and making one when it is clean. The matrix has neither flaw: who moves is read off its rows.

The trapezoid is for motions whose two ends are given or matter most; it cannot stream. The one in circulation mirrors
column n to -n instead of -1-n: with an even number of columns one is "clean" from the start, and stays pure noise.

CMDM Eq. 13 prints FSS rows K, K-L, K-2L, ... and can be read two ways: latents jump by L (`literal_matrix`), or they
take unit steps and are L steps apart (`schedule_matrix`). The text beneath it says that the next frame starts when the
current one is at K - L, and that the steps between the printed rows were left out to save space. That is the second,
and so is the released code: L is a stagger, not a step size. For K = 4, L = 2 and three latents:

    4 4 4 | 3 4 4 | 2 4 4 | 1 3 4 | 0 2 4 | 0 1 3 | 0 0 2 | 0 0 1 | 0 0 0       K + L (N - 1) + 1 rows
    4 4 4 | 2 4 4 | 0 2 4 | 0 0 2 | 0 0 0                                       the literal reading: K/L + N rows
"""

from dataclasses import dataclass

import numpy as np

KINDS = ("full", "autoregressive", "fss", "triangular", "trapezoid")


def schedule_matrix(
    num_latents: int,
    num_steps: int,
    uncertainty: int = 2,
    block_size: int = 1,
    kind: str = "fss",
    overlap: int | None = None,
) -> np.ndarray:
    """The noise levels (M,N), int64, with M = K + (the longest wait) + 1 rows (CMDM Eq. 13, FloodDiffusion Eq. 19).

    `uncertainty` L is read by "fss", "trapezoid" and, without an `overlap`, "triangular", which takes n_s = ceil(K/L);
    "full" is L = 0 and "autoregressive" is L = K by definition. `overlap` n_s is for "triangular" alone.
    ValueError: an unknown kind, a count below 1, a non-integer, an uncertainty outside 0..K, an overlap outside 1..K
    or for another kind.
    """
    plan = _read(num_latents, num_steps, uncertainty, block_size, kind, overlap)
    block = np.arange(plan.blocks)
    if kind == "triangular" and plan.stagger:
        wait = plan.steps * block // plan.overlap
    elif kind == "trapezoid":
        wait = plan.stagger * np.minimum(block, block[::-1])
    else:
        wait = plan.stagger * block
    row = np.arange(plan.steps + wait.max() + 1)[:, None]
    levels = np.clip(plan.steps + wait - row, 0, plan.steps)  # (M,B)
    return np.repeat(levels, block_size, axis=1)[:, :num_latents].astype(np.int64)  # (M,N)


def literal_matrix(num_latents: int, num_steps: int, uncertainty: int, block_size: int = 1) -> np.ndarray:
    """CMDM Eq. 13 to the letter: every latent jumps by L, the next one row later; (M,N), M = ceil(K/L) + blocks.

    One call where FSS makes L, because a latent gets K/L steps where the text promises K: it is FSS with ceil(K/L)
    steps, one apart. ValueError: as `schedule_matrix`, and an uncertainty of 0, which would never move.
    """
    plan = _read(num_latents, num_steps, _integer("uncertainty", uncertainty, low=1), block_size, "fss", None)
    row, block = np.arange(-(-plan.steps // plan.stagger) + plan.blocks)[:, None], np.arange(plan.blocks)
    levels = np.clip(plan.steps - plan.stagger * np.maximum(row - block, 0), 0, None)  # (M,B)
    return np.repeat(levels, block_size, axis=1)[:, :num_latents].astype(np.int64)  # (M,N)


@dataclass(frozen=True)
class ScheduleCost:
    """What a scheduling matrix costs."""

    rows: int  # M
    calls: int  # denoiser calls, M - 1; guidance doubles the batch of a call, not their number
    latents_in_flight: int  # the most that one call moves
    calls_to_first: int  # calls until the first latent is clean: K
    calls_per_further: float  # mean calls between blocks finished one after the other (0 if all finish together)


def cost(matrix: np.ndarray) -> ScheduleCost:
    """The cost of a scheduling matrix (M,N), counted on the matrix itself. ValueError: not a valid one."""
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


def closed_form_cost(
    num_latents: int,
    num_steps: int,
    uncertainty: int = 2,
    block_size: int = 1,
    kind: str = "fss",
    overlap: int | None = None,
) -> ScheduleCost:
    """The cost of `schedule_matrix` with these arguments, without the matrix. ValueError: as there."""
    plan = _read(num_latents, num_steps, uncertainty, block_size, kind, overlap)
    turns = plan.blocks  # how many times something starts
    if plan.stagger == 0:
        turns = 1
    elif kind == "trapezoid":
        turns = -(-plan.blocks // 2)
    last = plan.stagger * (turns - 1)  # the wait of whoever starts last
    if kind == "triangular" and plan.stagger:
        last = plan.steps * (turns - 1) // plan.overlap
    in_flight = min(num_latents, block_size * plan.overlap)
    if kind == "trapezoid" and plan.overlap < turns:  # two blocks a turn, but the middle one may be alone in the last
        in_flight = min(2 * block_size * plan.overlap, num_latents - block_size)
    elif kind == "trapezoid":
        in_flight = num_latents
    calls = plan.steps + last
    return ScheduleCost(calls + 1, calls, int(in_flight), plan.steps, last / (turns - 1) if turns > 1 else 0.0)


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


@dataclass(frozen=True)
class _Plan:
    steps: int  # K
    blocks: int  # B
    stagger: int  # L; for "triangular" only whether it is 0
    overlap: int  # n_s, the most turns in flight together: ceil(K / L), and all of them when L = 0


def _read(num_latents, num_steps, uncertainty, block_size, kind, overlap) -> _Plan:
    """The arguments of a schedule, checked."""
    if kind not in KINDS:
        raise ValueError(f"unknown schedule {kind!r}: expected one of {', '.join(KINDS)}")
    num_latents = _integer("num_latents", num_latents, low=1)
    num_steps = _integer("num_steps", num_steps, low=1)
    blocks = -(-num_latents // _integer("block_size", block_size, low=1))  # ceil(N / b)
    if overlap is not None:
        if kind != "triangular":
            raise ValueError(f"overlap is for the schedule 'triangular', and {kind!r} came: say uncertainty instead")
        if _integer("overlap", overlap, low=1) > num_steps:
            raise ValueError(f"overlap must be at most num_steps ({num_steps}), got {overlap}: blocks start one by one")
        return _Plan(num_steps, blocks, -(-num_steps // overlap), overlap)
    stagger = {"full": 0, "autoregressive": num_steps}.get(kind)
    if stagger is None:
        stagger = _integer("uncertainty", uncertainty, low=0)
        if stagger > num_steps:
            raise ValueError(
                f"uncertainty must be at most num_steps ({num_steps}), got {stagger}: "
                "a block would still wait after the one before it is finished"
            )
    return _Plan(num_steps, blocks, stagger, -(-num_steps // stagger) if stagger else blocks)


def _integer(name: str, value, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < low:
        raise ValueError(f"{name} must be an integer of at least {low}, got {value!r}")
    return int(value)
