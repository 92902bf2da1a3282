"""The measures of the field, each a function on plain numpy arrays: embeddings, joints or programs in, a number out.

    from minicmdm import metrics
    metrics.frechet_distance(generated, real)    metrics.r_precision(text, motion)    metrics.mpjpe(a, b) * 1000

Embeddings are (N,E), in the order of their pairs; joints are (T,22,3) in metres at 20 fps, Y up. Sums are float64.
A misshapen or empty array, NaN or infinity is a ValueError. Most numbers mean something only beside the ground truth's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from minicmdm.data.features import facing_yaw, turn
from minicmdm.data.programs import FIELDS, Program, score
from minicmdm.data.skeleton import KIT21, NUM_JOINTS, skeleton_of

# Which way is better, as papers print it; "→" is nearer to the ground truth. (A frozen body has the least skating.)
_UP = "oracle_accuracy oracle_accuracy_heldout r_at_1 r_at_2 r_at_3 multimodality clip_score m2t m2m"
_DOWN = "mm_dist fid skating_ratio mpjpe_mm pa_mpjpe_mm accel_mm auj transition_fid transition_distance_cm"
_NEAR = "diversity pj segments_found"
ARROWS = dict.fromkeys(_UP.split(), "↑") | dict.fromkeys(_DOWN.split(), "↓") | dict.fromkeys(_NEAR.split(), "→")

CONTACT_HEIGHT, SKATING_SPEED, SKATING_WINDOW = 0.05, 0.5, 5  # m, m/s (a comment in the release says 0.2), steps


def confidence(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half-width of the 95 % interval over repeats: 1.96 std / sqrt(n), and 0 for a single value.

    std divides by n (ddof 0), as everywhere in this field; Student's t would be 10 % wider for n = 20, 58 % for n = 5.
    """
    values = _array("values", values, "n")
    return float(values.mean()), float(1.96 * values.std() / np.sqrt(len(values)))


def r_precision(text: np.ndarray, motion: np.ndarray, pool: int = 32, rng: Generator | None = None) -> np.ndarray:
    """R@1, R@2, R@3 (3,): how often a text (N,E) finds its own motion (N,E) among the k nearest of a pool.

    Pools are cut in order, or after `rng` has shuffled the pairs; a last, smaller pool is left out. Motions at equal
    distance share their places, so embeddings that are all the same score chance, k / pool. Another motion with the
    same caption counts as wrong. ValueError if N < pool. Source: Guo et al. 2022.
    """
    text, motion = _alike("N", "E", text=text, motion=motion)
    if not 1 <= pool <= len(text):
        raise ValueError(f"a pool of {pool} needs at least 1 and at most N = {len(text)} pairs of text and motion")
    if rng is not None:
        order = rng.permutation(len(text))
        text, motion = text[order], motion[order]
    hits, count = np.zeros(3), len(text) // pool * pool
    for i in range(count):
        start = i // pool * pool
        # |x - y| itself: its expansion into x.x - 2 x.y + y.y loses near neighbours to rounding
        distance = np.linalg.norm(motion[start : start + pool] - text[i], axis=1)  # (pool,)
        closer, level = (distance < distance[i - start]).sum(), (distance == distance[i - start]).sum()
        hits += np.clip((np.arange(1, 4) - closer) / level, 0, 1)
    return hits / count


def mm_distance(text: np.ndarray, motion: np.ndarray) -> float:
    """MM-Dist: mean Euclidean distance of a text (N,E) to its own motion (N,E). Source: Guo et al. 2022."""
    text, motion = _alike("N", "E", text=text, motion=motion)
    return float(np.linalg.norm(text - motion, axis=1).mean())


def clip_score(text: np.ndarray, motion: np.ndarray) -> float:
    """Mean cosine of a text (N,E) and its own motion (N,E), -1 to 1: not clipped at 0, not times 2.5 (MARDM)."""
    return float(_cosines(text=text, motion=motion).mean())


def tmr_score(a: np.ndarray, b: np.ndarray) -> float:
    """Mean (cosine + 1) / 2 of pairs (N,E): M2T with motion and text, M2M with motion and true motion (STMC)."""
    return float((_cosines(a=a, b=b).mean() + 1) / 2)


def frechet_distance(a: np.ndarray, b: np.ndarray) -> float:
    """FID: squared Fréchet distance of the Gaussians that fit embeddings a (N,E) and b (M,E).

    |mean_a - mean_b|^2 + Tr(C_a + C_b - 2 (C_a C_b)^(1/2)), with covariances that divide by N - 1. Two draws of one
    Gaussian score more than 0, the more the wider E and the smaller N. ValueError if N or M < 2. (Heusel et al. 2017)
    """
    a = _array("a", a, "N >= 2", "E")
    b = _array("b", b, "M >= 2", a.shape[1])
    cov_a, cov_b = (np.atleast_2d(np.cov(x, rowvar=False)) for x in (a, b))  # (E,E)
    # The eigenvalues of C_a C_b are the squared singular values of C_a^(1/2) C_b^(1/2): summing these needs no further
    # root, which would magnify the rounding of singular covariances (N < E).
    overlap = np.linalg.norm(_root(cov_a) @ _root(cov_b), "nuc")
    distance = np.square(a.mean(0) - b.mean(0)).sum() + np.trace(cov_a) + np.trace(cov_b) - 2 * overlap
    return max(float(distance), 0.0)


def diversity(motion: np.ndarray, rng: Generator, pairs: int = 300) -> float:
    """Mean Euclidean distance of random pairs among motions (N,E): `pairs` of them, or 100 if N <= `pairs`.

    No pair comes twice, and no motion meets itself (in the released codes it does, once in N). Where there are not
    so many pairs, all are taken. ValueError if N < 2. Source: Guo et al. 2022.
    """
    motion = _array("motion", motion, "N >= 2", "E")
    i, j = _different_pairs(len(motion), pairs if len(motion) > pairs else min(pairs, 100), rng)
    return float(np.linalg.norm(motion[i] - motion[j], axis=-1).mean())


def multimodality(motion: np.ndarray, rng: Generator, pairs: int = 10) -> float:
    """Mean Euclidean distance between motions (texts, samples, E) of the same text, over `pairs` shared by all texts.

    Pairs are as in `diversity`. In the released codes a sample may meet itself, which lowers their numbers by one part
    in `samples` (3 % with 30). ValueError if there are fewer than 2 samples. Source: Guo et al. 2022.
    """
    motion = _array("motion", motion, "texts", "samples >= 2", "E")
    i, j = _different_pairs(motion.shape[1], pairs, rng)
    return float(np.linalg.norm(motion[:, i] - motion[:, j], axis=-1).mean())


def mpjpe(a: np.ndarray, b: np.ndarray, root_align: bool = True) -> float:
    """Mean distance (m) of the joints of a and b (T,22,3); `root_align` first moves each pelvis to the origin."""
    a, b = _alike("T", _count(a), 3, a=a, b=b)
    if root_align:
        a, b = a - a[:, :1], b - b[:, :1]
    return float(np.linalg.norm(a - b, axis=-1).mean())


def pa_mpjpe(a: np.ndarray, b: np.ndarray) -> float:
    """Mean joint distance (m) once every frame of a (T,22,3) is moved, turned and scaled to fit b best (Procrustes).

    Best is least squares, without reflections. It is not symmetric: the scale is b's.
    """
    a, b = (x - x.mean(1, keepdims=True) for x in _alike("T", _count(a), 3, a=a, b=b))
    u, _, vt = np.linalg.svd(a.transpose(0, 2, 1) @ b)  # (T,3,3)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]  # where a mirror fits best, the best rotation instead
    turned = a @ u @ vt  # (T,22,3)
    size = np.square(a).sum((1, 2), keepdims=True)  # (T,1,1); a body shrunk to a point has no scale and stays one
    scale = np.divide((turned * b).sum((1, 2), keepdims=True), size, out=np.zeros_like(size), where=size > 0)
    return float(np.linalg.norm(scale * turned - b, axis=-1).mean())


def accel(a: np.ndarray, b: np.ndarray) -> float:
    """ACCEL: mean distance (m/frame^2) of second differences over time of a and b (T,22,3), T >= 3, nothing aligned."""
    a, b = _alike("T >= 3", _count(a), 3, a=a, b=b)
    return float(np.linalg.norm(np.diff(a - b, n=2, axis=0), axis=-1).mean())


def jerk_curve(windows: np.ndarray) -> np.ndarray:
    """Jerk around a transition (L-3,), in metres per frame cubed, of windows (W,L,22,3) centred on transitions.

    The third difference, L1 over x, y, z, largest over joints, averaged over windows. L1 hears how a window stands:
    let each start at the origin facing +Z. ValueError if L < 4. Source: FlowMDM (Barquero et al. 2024), with L = 60.
    """
    windows = _array("windows", windows, "W", "L >= 4", NUM_JOINTS, 3)
    jerk = np.abs(np.diff(windows, n=3, axis=1)).sum(-1)  # (W,L,22,3) -> (W,L-3,22)
    return jerk.max(-1).mean(0)


def peak_jerk(windows: np.ndarray) -> float:
    """PJ: the highest point of `jerk_curve`. It sees seams: spikes that come at other times average out."""
    return float(jerk_curve(windows).max())


def area_under_jerk(windows: np.ndarray, reference: float) -> float:
    """AUJ: area between `jerk_curve` and `reference`, the mean jerk of true windows (0.033031363 for HumanML3D)."""
    return float(np.abs(jerk_curve(windows) - _array("reference", reference)).sum())


def transition_distance(joints: np.ndarray, boundaries: Sequence[int]) -> float:
    """How far (cm) the pose of joints (T,22,3) jumps into each boundary frame, over joints and boundaries.

    The jump is from k - 1 to k for each boundary k in 1..T-1, seen from the pelvis and the body's heading, so walking
    and turning cost nothing. (STMC's script takes each joint's own x off it, for generated motions.) Source: TEACH.
    """
    joints = _array("joints", joints, "T >= 2", NUM_JOINTS, 3)
    cuts = np.unique(np.asarray(boundaries))
    if cuts.size == 0 or cuts.dtype.kind not in "iu" or cuts[0] < 1 or cuts[-1] >= len(joints):
        raise ValueError(f"boundaries must be frames from 1 to {len(joints) - 1}, at least one, got {boundaries}")
    pose = turn(joints - joints[:, :1], -facing_yaw(joints))  # (T,22,3)
    return float(np.linalg.norm(pose[cuts] - pose[cuts - 1], axis=-1).mean() * 100)


def skating_ratio(joints: np.ndarray) -> float:
    """Share of the T-1 steps in which a foot on the floor slides: joints (T,22,3), standing on y = 0, T >= 2.

    On the floor is below 5 cm before and after the step; sliding is faster than 0.5 m/s over the floor, in this step
    and on average over the five around it (steps beyond the ends count as still). Source: GMD (Karunratanakul 2023).
    """
    joints = _array("joints", joints, "T >= 2", _count(joints), 3)
    body = skeleton_of(joints.shape[1])
    feet = joints[:, body.feet]  # (T,2,3)
    speed = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1) * body.fps  # (T-1,2)
    around = np.pad(speed, ((SKATING_WINDOW // 2,) * 2, (0, 0)))
    average = np.lib.stride_tricks.sliding_window_view(around, SKATING_WINDOW, axis=0).mean(-1)  # (T-1,2)
    low = feet[..., 1] < CONTACT_HEIGHT
    slides = low[:-1] & low[1:] & (speed > SKATING_SPEED) & (average > SKATING_SPEED)
    return float(slides.any(axis=1).mean())


def segment_accuracy(asked: Sequence[Program], found: Sequence[Program]) -> float:
    """Right segments / max(asked, found), summed over clips; right is in its place with every stated field."""
    pairs = [score(a, f) for a, f in _same_count(asked, found)]
    return sum(right for right, _ in pairs) / max(sum(of for _, of in pairs), 1)


def clip_accuracy(asked: Sequence[Program], found: Sequence[Program]) -> float:
    """Share of clips in which every segment is right and none is too many."""
    return float(np.mean([right == of for right, of in (score(a, f) for a, f in _same_count(asked, found))] or [0.0]))


def field_accuracy(asked: Sequence[Program], found: Sequence[Program]) -> dict[str, float]:
    """Share of stated fields that are right, segment by segment in its place; fields nobody stated are left out."""
    hits: dict[str, list[bool]] = {name: [] for name in FIELDS}
    for a, f in _same_count(asked, found):
        for k, segment in enumerate(a):
            for name in FIELDS:
                if getattr(segment, name) is not None:
                    hits[name].append(k < len(f) and getattr(f[k], name) == getattr(segment, name))
    return {name: float(np.mean(values)) for name, values in hits.items() if values}


def _array(name: str, value: object, *shape: str | int) -> np.ndarray:
    """Float64, finite, of this shape: a number is exact, a letter is anything from 1, or from 3 in "T >= 3"."""
    array = np.asarray(value, dtype=np.float64)
    least = [want if isinstance(want, int) else int((want + ">= 1").split(">=")[1]) for want in shape]
    fits = [have == low or (have > low and isinstance(want, str)) for have, low, want in zip(array.shape, least, shape)]
    if array.ndim != len(shape) or not all(fits):
        raise ValueError(f"{name} must have shape ({', '.join(map(str, shape))}), nothing empty, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, but it holds NaN or infinity, which would spoil every mean")
    return array


def _count(joints: object) -> int:
    """How many joints must be there: 22, but for a body that is whole with KIT-ML's 21."""
    return KIT21.num_joints if np.shape(joints)[-2:] == (KIT21.num_joints, 3) else NUM_JOINTS


def _alike(*shape: str | int, **arrays: object) -> list[np.ndarray]:
    a, b = checked = [_array(name, array, *shape) for name, array in arrays.items()]
    if a.shape != b.shape:
        raise ValueError(f"{' and '.join(arrays)} belong in pairs and need one shape, got {a.shape} and {b.shape}")
    return checked


def _cosines(**arrays: object) -> np.ndarray:
    a, b = _alike("N", "E", **arrays)
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    if not lengths.all():
        raise ValueError(f"pair {int(lengths.argmin())} holds a zero embedding, which has no angle to anything")
    return (a * b).sum(1) / lengths


def _root(covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(values.clip(0)) @ vectors.T


def _different_pairs(count: int, pairs: int, rng: Generator) -> tuple[np.ndarray, np.ndarray]:
    """Up to `pairs` different ordered pairs (i, j), i != j, of 0..count-1."""
    if pairs < 1:
        raise ValueError(f"pairs must be at least 1, got {pairs}")
    every = count * (count - 1)
    i, j = np.divmod(rng.choice(every, min(pairs, every), replace=False), count - 1)
    return i, j + (j >= i)


def _same_count(asked: Sequence[Program], found: Sequence[Program]) -> list[tuple[Program, Program]]:
    if len(asked) != len(found):
        raise ValueError(f"asked and found are pairs of programs, got {len(asked)} and {len(found)}")
    return list(zip(asked, found))
