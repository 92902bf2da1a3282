"""The exercises of notebook 08: the schedule matrix, its laws, its price, and a trapezoid with a hole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minicmdm.diffusion.schedules import KINDS, check_matrix, cost, literal_matrix, schedule_matrix
from minicmdm.exercises.frame import Exercise, must

SHAPES = [(1, 1), (2, 1), (2, 2), (3, 2), (3, 4), (4, 5), (5, 3)]  # latents, steps; then random larger ones


def _cases(seed: int) -> list[tuple[int, int, int]]:
    """(num_latents, num_steps, uncertainty), from small to large, every stagger from 0 to K among the small."""
    rng = np.random.default_rng(seed)
    small = [(latents, steps, stagger) for latents, steps in SHAPES for stagger in range(steps + 1)]
    shapes = [(int(rng.integers(6, 30)), int(rng.integers(6, 25))) for _ in range(5)]
    return small + [(latents, steps, int(rng.integers(1, steps))) for latents, steps in sorted(shapes)]


def _prove_fss(answer: Callable) -> None:
    for latents, steps, stagger in _cases(1):
        matrix, right = np.asarray(answer(latents, steps, stagger)), schedule_matrix(latents, steps, stagger)
        must(matrix.ndim == 2 and matrix.shape[1] == latents, f"One column for each of the {latents} latents.")
        must((matrix[0] == steps).all(), f"Before the first call every latent is pure noise, level {steps}.")
        must((matrix >= 0).all() and (matrix <= steps).all(), f"Levels stay between 0 and {steps}: clip them.")
        must(not matrix[-1].any(), "In the last row every latent is clean.")
        must(len(matrix) <= len(right), f"K + L(N-1) + 1 = {len(right)} rows are enough.")
        must((np.diff(matrix, axis=0) >= -1).all(), "A latent goes down one level a call: L is a stagger, not a step.")
        starts = [int((column == steps).sum()) for column in matrix.T]  # rows in which each latent is pure noise
        must((np.diff(starts) == stagger).all(), f"Each latent starts {stagger} calls after its left neighbour.")
        must(np.array_equal(matrix, right), "Row m, latent n: clip(K + L n - m, 0, K).")


def is_schedule(matrix: np.ndarray) -> bool:
    """Whether levels (M,N) are a schedule: all start at one K >= 1, none ever rises, all end at 0."""
    first, last = matrix[0], matrix[-1]
    together = bool((first == first[0]).all()) and first[0] >= 1
    return bool(together and (np.diff(matrix, axis=0) <= 0).all() and (last == 0).all())


def _prove_is_schedule(answer: Callable) -> None:
    def put(matrix: list | np.ndarray, law: str) -> None:
        matrix = np.array(matrix)
        try:
            right = check_matrix(matrix) is not None
        except ValueError:
            right = False
        must(bool(answer(matrix)) is right, law)

    put([[1], [0]], "The smallest schedule: one latent, one step.")
    put([[0], [0]], "K is at least 1: what begins clean was never sampled.")
    put([[2], [1]], "Every latent ends clean.")
    put([[1, 0], [0, 0]], "Every latent begins at the same K. Here one is clean from the start: its noise stays.")
    put([[2, 1], [1, 1], [0, 0]], "Every latent begins at the same K: a level below K is not pure noise.")
    put([[2, 2], [1, 2], [0, 1]], "Every latent ends clean, not only the first.")
    put([[2], [1], [2], [0]], "A level never rises, not even for a moment.")
    put([[4, 4], [2, 4], [0, 2], [0, 0]], "Steps of 2 are steps: a level may fall by more than 1 in a call.")
    put([[2], [2], [1], [1], [0], [0]], "A row in which nothing moves breaks no law.")
    rng = np.random.default_rng(2)
    for latents, steps, stagger in _cases(2)[-4:]:
        for kind in KINDS:
            put(schedule_matrix(latents, steps, stagger, kind=kind), f"The schedule '{kind}' is one.")
        put(literal_matrix(latents, steps, stagger), "Eq. 13 to the letter is a schedule too.")
        broken = schedule_matrix(latents, steps, stagger)
        m, n = int(rng.integers(1, len(broken))), int(rng.integers(latents))
        broken[m, n] = broken[m - 1, n] + 1
        put(broken, f"Latent {n} rises after row {m - 1}.")


def fss_cost(num_latents: int, num_steps: int, uncertainty: int, block_size: int) -> tuple[int, int, int]:
    """Of FSS: calls in all, the most latents in flight, and calls until the first latent is clean."""
    blocks = -(-num_latents // block_size)  # rounded up
    calls = num_steps + uncertainty * (blocks - 1)  # the last block waits L for each one before it, then takes K steps
    if uncertainty == 0:
        return calls, num_latents, num_steps
    together = -(-num_steps // uncertainty)  # blocks that start before the first of them is finished
    return calls, min(num_latents, block_size * together), num_steps


def _prove_cost(answer: Callable) -> None:
    for latents, steps, stagger in _cases(3):
        for block in (1, 2, 3):
            calls, flight, first = answer(latents, steps, stagger, block)
            right = cost(schedule_matrix(latents, steps, stagger, block))  # counted on the matrix itself
            must(first == right.calls_to_first, "The first latent never waits: it takes its K steps.")
            must(calls == right.calls, f"{right.calls} calls: the last of ceil(N/b) blocks waits L for each before it.")
            must(
                flight == right.latents_in_flight,
                f"{right.latents_in_flight} latents move in the busiest call: blocks start every L calls, fly for K; "
                "no more can fly than there are, and with L = 0 all do.",
            )


def trapezoid(num_latents: int, num_steps: int, uncertainty: int) -> np.ndarray:
    """Both ends first, the middle last: (M,N) levels."""
    half = -(-num_latents // 2)  # columns from an end to the middle
    levels = np.zeros((num_steps + uncertainty * (half - 1) + 1, num_latents), dtype=int)
    for m in range(len(levels)):
        for n in range(half):
            level = np.clip(num_steps + uncertainty * n - m, 0, num_steps)
            levels[m, n] = levels[m, num_latents - 1 - n] = level  # the mirror of column 0 is column N-1
    return levels


def _prove_trapezoid(answer: Callable) -> None:
    for latents, steps, stagger in _cases(4):
        matrix = np.asarray(answer(latents, steps, stagger))
        right = schedule_matrix(latents, steps, stagger, kind="trapezoid")
        must(matrix.ndim == 2 and matrix.shape[1] == latents, f"One column for each of the {latents} latents.")
        must((matrix[0] == steps).all(), f"Every latent starts at level {steps}; one that starts at 0 stays noise.")
        must((matrix == matrix[:, ::-1]).all(), "It reads the same from the right as from the left.")
        must(not matrix[-1].any(), "In the last row every latent is clean.")
        must(np.array_equal(matrix, right), "Column n waits L calls for each column between it and the nearer end.")


EXERCISES = (
    Exercise(
        "08.1",
        "one row for every moment, 0 to K + L(N-1); latent n waits L n rows at level K and then loses one level a row. "
        "np.clip(levels, 0, K) does the waiting and the stopping.",
        schedule_matrix,
        _prove_fss,
    ),
    Exercise(
        "08.2",
        "three laws, three lines: the first row, the differences from row to row (np.diff), the last row.",
        is_schedule,
        _prove_is_schedule,
    ),
    Exercise(
        "08.3",
        "count in blocks first: -(-N // b). When does the last one start? How many start while the first flies?",
        fss_cost,
        _prove_cost,
    ),
    Exercise(
        "08.4",
        "write down for 4 latents which columns the loop fills, when n is 0 and when it is 1. Which column is -0?",
        trapezoid,
        _prove_trapezoid,
    ),
)
