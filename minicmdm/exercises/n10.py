"""The exercises of notebook 10: evaluation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minicmdm.evaluation import metrics
from minicmdm.evaluation.metrics import ARROWS, frechet_distance, r_precision
from minicmdm.exercises.frame import Exercise, must

Measure = Callable[[np.ndarray, np.ndarray], dict[str, float]]


def _near(a: object, b: float) -> bool:
    return bool(np.isclose(float(a), b, rtol=1e-5, atol=1e-5))  # a root of rounding is large already


def _prove_frechet(answer: Callable) -> None:
    for size, other, width in [(3, 3, 1), (4, 7, 1), (12, 9, 2), (40, 50, 5), (8, 9, 12)]:
        rng = np.random.default_rng(width)
        a = rng.standard_normal((size, width)) @ rng.standard_normal((width, width))
        b = rng.standard_normal((other, width)) + 1
        must(_near(answer(a, a), 0.0), "From a cloud of points to itself it is 0.")
        law = "A cloud that is only moved is as far as the move, squared: the spreads cancel."
        must(_near(answer(a + 3, a), 9.0 * width), law)
        if width == 1:
            closed = (a.mean() - b.mean()) ** 2 + (a.std(ddof=1) - b.std(ddof=1)) ** 2
            must(_near(answer(a, b), closed), "In one dimension it is (mean - mean)^2 + (std - std)^2, with N - 1.")
        law = "|mean - mean|^2 + Tr(C_a + C_b - 2 (C_a C_b)^(1/2)), a root of the matrix and not of its numbers."
        must(_near(answer(a, b), frechet_distance(a, b)), law)
        must(_near(answer(b, a), frechet_distance(a, b)), "It is as far from b to a as from a to b.")


def _prove_r_precision(answer: Callable) -> None:
    for count, pool, width in [(1, 1, 2), (4, 2, 3), (9, 4, 2), (24, 8, 5), (70, 32, 8)]:
        rng = np.random.default_rng(count)
        motion = rng.standard_normal((count, width))
        mixed = motion * rng.uniform(0.5, 3, (count, 1)) + rng.standard_normal((count, width))
        far = np.arange(count)[:, None] * np.ones(width) * 10.0
        must(np.allclose(answer(far, far, pool), 1), "Texts that lie on their own motions always find them, R@1 too.")
        found = np.asarray(answer(mixed, motion, pool), dtype=float)
        must(found.shape == (3,), "Three numbers come out: R@1, R@2, R@3.")
        must((np.diff(found) >= -1e-12).all(), "Who is among the first two is also among the first three.")
        law = (
            "Each text ranks the motions of its own pool by Euclidean distance; pools are cut in order, a rest is left."
        )
        must(np.allclose(found, r_precision(mixed, motion, pool)), law)


def frozen_wins(motion: np.ndarray, truth: np.ndarray, measure: Measure) -> set[str]:
    """Names of the measures by which `motion` (T,22,3) would do better if it held its first pose to the end.

    measure(motion, truth) gives numbers by name; metrics.ARROWS says which way is better, "→" being nearer to the
    truth's own number, measure(truth, truth).
    """
    statue = np.repeat(motion[:1], len(motion), axis=0)
    still, moving, ideal = measure(statue, truth), measure(motion, truth), measure(truth, truth)
    better = {
        "↑": lambda name: still[name] > moving[name],
        "↓": lambda name: still[name] < moving[name],
        "→": lambda name: abs(still[name] - ideal[name]) < abs(moving[name] - ideal[name]),
    }
    return {name for name in still if better[ARROWS[name]](name)}


def _measures(motion: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    return {
        "skating_ratio": metrics.skating_ratio(motion),
        "mpjpe_mm": 1000 * metrics.mpjpe(motion, truth),
        "accel_mm": 1000 * metrics.accel(motion, truth),
        "pj": metrics.peak_jerk(motion[None]),
        "multimodality": float(np.ptp(motion, axis=0).mean()),  # stands for a number that should be high
    }


def _prove_frozen(answer: Callable) -> None:
    for frames, noise in [(4, 0.0), (5, 0.3), (8, 0.02), (13, 0.02), (21, 0.3), (34, 0.0)]:
        rng = np.random.default_rng(frames)
        truth = rng.standard_normal((1, 22, 3)) + 0.05 * rng.standard_normal((frames, 22, 3)).cumsum(0)
        truth[:, (10, 11), 1] = 0  # the feet stay on the floor
        motion = truth + noise * rng.standard_normal(truth.shape) * [1, 0, 1]
        already = np.repeat(motion[:1], frames, axis=0)
        for a, b in ((motion, truth), (truth, motion), (already, truth)):
            said, wanted = set(answer(a, b, _measures)), frozen_wins(a, b, _measures)
            for name in sorted(wanted - said):
                must(False, f"The statue is better by {name} ({ARROWS[name]}), which is missing.")
            for name in sorted(said - wanted):
                must(False, f"The statue is not better by {name} ({ARROWS[name]}).")


EXERCISES = (
    Exercise(
        "10.1",
        "means a.mean(0), covariances np.cov(a, rowvar=False) (np.atleast_2d helps where E is 1). The trace of the "
        "root of C_a C_b is the sum of the roots of its eigenvalues (np.linalg.eigvals: the real part, not below 0).",
        frechet_distance,
        _prove_frechet,
    ),
    Exercise(
        "10.2",
        "for each whole pool: distances (pool, pool) of texts, down, to motions, across; how many motions are nearer "
        "to text i than motion i is? Fewer than k of them: a hit for R@k.",
        r_precision,
        _prove_r_precision,
    ),
    Exercise(
        "10.3",
        "np.repeat(motion[:1], len(motion), axis=0) is the statue. Measure it, the motion, and the truth against "
        "itself; compare by the arrow. As good is not better.",
        frozen_wins,
        _prove_frozen,
    ),
)
