"""The exercises of notebook 11: long horizon."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from minicmdm.data.features import canonicalize, facing_yaw, turn
from minicmdm.evaluation.metrics import jerk_curve, transition_distance
from minicmdm.exercises.frame import Exercise, must


def _close(a: object, b: object) -> bool:
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-6, atol=1e-9))


def _walk(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Joints (T,22,3) that stand, turn, travel and tremble: the hips across x, as in a body that faces +Z."""
    body = rng.uniform(-0.5, 0.5, (22, 3)) + [0, 1, 0]
    body[[1, 2, 16, 17], 0] = [0.1, -0.1, 0.2, -0.2]  # hips and shoulders, left ones first
    body[[1, 2, 16, 17], 2] = 0
    joints = body + 0.03 * rng.standard_normal((frames, 22, 3))
    joints = turn(joints, 0.1 * np.arange(frames) + rng.uniform(-3, 3))
    return joints + np.arange(frames)[:, None, None] * [0.05, 0, 0.1] + [2.0, 0, -1.0]


def _prove_jerk(answer: Callable) -> None:
    for count, length in [(1, 4), (1, 5), (2, 5), (3, 8), (5, 13), (8, 30)]:
        rng = np.random.default_rng(length)
        still = np.broadcast_to(rng.standard_normal((count, 1, 22, 3)), (count, length, 22, 3))
        time = np.arange(length)[:, None, None]
        curve = np.asarray(answer(still))
        must(
            curve.shape == (length - 3,),
            f"{length} frames have {length - 3} third differences, one curve for all windows.",
        )
        must(_close(curve, np.zeros(length - 3)), "What stands still has no jerk.")
        falling = still + 0.3 * time - 0.01 * time**2
        must(np.allclose(answer(falling), 0, atol=1e-6), "A steady acceleration has no jerk either.")
        jump = still.copy()
        jump[:, length // 2 :, 7, 0] += 0.1  # one joint, once
        peak = 0.2 if length > 5 else np.max(jerk_curve(jump))
        must(
            np.isclose(np.max(answer(jump)), peak),
            "A joint that jumps 10 cm once makes .1, .2, .1: the largest joint counts.",
        )
        moving = rng.standard_normal((count, length, 22, 3))
        law = "|third difference|, summed over x, y, z (L1), largest joint of a window, then the mean of windows."
        must(_close(answer(moving), jerk_curve(moving)), law)


def transition_windows(joints: np.ndarray, seams: Sequence[int], length: int) -> np.ndarray:
    """Of joints (T,22,3) the `length` frames from k - length // 2 on for each seam k, (W,length,22,3).

    Windows that would reach beyond either end are left out. Each is moved and turned as a whole, so that its own first
    frame stands at x = z = 0 and faces +Z.
    """
    first = [k - length // 2 for k in seams]
    inside = [k for k in first if k >= 0 and k + length <= len(joints)]
    return np.array([canonicalize(joints[k : k + length]) for k in inside]).reshape(-1, length, 22, 3)


def _prove_windows(answer: Callable) -> None:
    for frames, seams, length in [
        (8, [4], 4),
        (9, [4], 5),
        (12, [1, 6], 4),
        (12, [6, 11], 4),
        (20, [5, 10, 15], 10),
        (40, [3, 9, 20, 31, 38], 13),
        (90, [30, 61, 75], 30),
    ]:
        rng = np.random.default_rng(frames)
        joints = _walk(frames, rng)
        kept, right = joints.copy(), transition_windows(joints, seams, length)
        cut = np.asarray(answer(joints, seams, length))
        must(np.array_equal(joints, kept), "The motion that comes in stays as it is.")
        must(
            cut.shape == right.shape,
            f"{len(right)} of {len(seams)} windows lie inside the motion, each {length} frames long.",
        )
        must(np.allclose(cut[:, 0, 0][:, [0, 2]], 0), "The pelvis of each window's first frame is at x = z = 0.")
        must(np.allclose([facing_yaw(w[:1])[0] for w in cut], 0, atol=1e-6), "Each window's first frame faces +Z.")
        law = (
            "A window keeps its own travel and turning: one shift and one angle for all its frames, those of the first."
        )
        must(np.allclose(np.ptp(cut[..., 0, 1], axis=1), np.ptp(right[..., 0, 1], axis=1)), law)
        must(
            np.allclose(np.linalg.norm(np.diff(cut, axis=1), axis=-1), np.linalg.norm(np.diff(right, axis=1), axis=-1)),
            law,
        )
        must(np.allclose(cut, right, atol=1e-6), "From k - length // 2 on, heights untouched.")


def _prove_distance(answer: Callable) -> None:
    for frames, seams in [(2, [1]), (3, [1, 2]), (5, [3]), (12, [4, 8]), (30, [7, 13, 29]), (50, [10, 20, 30, 40])]:
        rng = np.random.default_rng(frames)
        time = np.arange(frames)[:, None, None]
        still = np.repeat(_walk(1, rng), frames, axis=0)
        must(_close(answer(still, seams), 0.0), "A statue does not jump.")
        glide = still + time * [0.0, 0.0, 0.1]
        law = "A body that glides forward keeps its pose: take the pelvis off, all three of its coordinates."
        must(np.isclose(answer(glide, seams), 0.0, atol=1e-6), law)
        glide = still + time * [0.1, 0.02, 0.0]
        must(np.isclose(answer(glide, seams), 0.0, atol=1e-6), law)
        law = "A body that turns on the spot keeps its pose: turn every frame back by its own facing."
        must(np.isclose(answer(turn(still, 0.2 * np.arange(frames)), seams), 0.0, atol=1e-6), law)
        joints = _walk(frames, rng)
        law = "In cm: the mean over joints and seams of how far a joint is at k from where it was at k - 1."
        must(np.isclose(answer(joints, seams), transition_distance(joints, seams), rtol=1e-6), law)


EXERCISES = (
    Exercise(
        "11.1",
        "np.diff(windows, n=3, axis=1) is (W,L-3,22,3). Then |.|, a sum over xyz, a maximum over joints, a mean over "
        "windows, in this order.",
        jerk_curve,
        _prove_jerk,
    ),
    Exercise(
        "11.2",
        "joints[k - length // 2 : k - length // 2 + length], if both ends lie inside (a negative start would count "
        "from the end!), and canonicalize(window) stands it at the origin, facing +Z.",
        transition_windows,
        _prove_windows,
    ),
    Exercise(
        "11.3",
        "joints[:, :1] is the pelvis of every frame, (T,1,3); joints[:, :, :1] is every joint's x. turn(pose, "
        "-facing_yaw(joints)) takes the heading off. Metres come in, centimetres go out.",
        transition_distance,
        _prove_distance,
    ),
)
