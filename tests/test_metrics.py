"""Every metric against a closed form or a case done by hand; and the same assertions reject plainly wrong variants."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from minicmdm.data import features as ft
from minicmdm.data import skeleton as sk
from minicmdm.data.programs import Segment
from minicmdm.evaluation import metrics as m
from minicmdm.evaluation import quick

REFERENCE = Path(__file__).resolve().parents[2] / "shared" / "reference" / "humanml3d"
needs_reference = pytest.mark.skipif(
    not REFERENCE.is_dir(),
    reason=f"the HumanML3D reference clip is not at {REFERENCE} (it may not be shipped)",
)
CASES = []  # (check, right, wrong): check(right) passes, check(wrong) raises AssertionError


def case(right, *mutants):
    """Register a check of the function `right` which every mutant must fail."""

    def register(check):
        CASES.append((check, right, mutants))
        return check

    return register


def close(a, b, tolerance=1e-9):
    return np.allclose(a, b, rtol=tolerance, atol=tolerance)


def rng(seed=0):
    return np.random.default_rng(seed)


def norm(x):
    return np.linalg.norm(x, axis=-1)


def motion(frames=12, seed=0):
    """A body whose joints, hips and shoulders apart, jitter about the rest pose: (T,22,3)."""
    rest = sk.forward_kinematics(np.tile([1.0, 0, 0, 0], (22, 1)), np.array([0, 0.95, 0]))
    jitter = rng(seed).normal(0, 0.05, (frames, 22, 3))
    jitter[:, [1, 2, 16, 17]] = 0
    return rest + jitter


def seen_differently(joints, seed=1):
    """Every frame turned about +Y and moved by its own amount."""
    r = rng(seed)
    return ft.turn(joints, r.uniform(-3, 3, len(joints))) + r.normal(size=(len(joints), 1, 3))


# --- Embeddings -----------------------------------------------------------------------------------------------------


def cosine_ranks(text, motion, pool=32, rng=None):
    unit = [x / (norm(x)[:, None] + 1e-9) for x in (text, motion)]
    return m.r_precision(*unit, pool, rng)


def first_wins(text, motion, pool=32, rng=None):
    """Counts who is strictly closer, so that a tie is a hit."""
    hits = []
    for s in range(0, len(text) // pool * pool, pool):
        d = norm(text[s : s + pool, None] - motion[None, s : s + pool])
        hits += list((d < np.diag(d)[:, None]).sum(1))
    return np.array([np.mean(np.array(hits) < k) for k in (1, 2, 3)])


def keeps_the_rest(text, motion, pool=32, rng=None):
    parts = [(len(text[s : s + pool]), s) for s in range(0, len(text), pool)]
    return sum(n * m.r_precision(text[s : s + n], motion[s : s + n], n) for n, s in parts) / len(text)


@case(
    m.r_precision,
    lambda text, motion, pool=32, rng=None: m.r_precision(motion, text, pool, rng),
    lambda text, motion, pool=32, rng=None: m.r_precision(text, motion, len(text), rng),
    lambda text, motion, pool=32, rng=None: m.r_precision(text, motion, pool, rng)[[0, 0, 0]],
    cosine_ranks,
    first_wins,
    keeps_the_rest,
)
def check_r_precision(r_precision):
    # Text at 1 is nearer to the motions at 1.9, 0 and 3.1 than to its own at 5. (Asked the other way round, the motion
    # at 5 prefers 3 and 2 only: third.) In the second pool places 2, 1, 1, 3. The fifth pair of each is cut off.
    text = np.array([0, 1, 2, 3, 0, 10, 20, 30, 7])[:, None] + 0.0
    motion = np.array([0, 5, 1.9, 3.1, 2, 10.5, 20, 0.5, 0])[:, None]
    assert close(r_precision(text[:4], motion[:4], pool=4), [3 / 4, 3 / 4, 3 / 4])
    assert close(r_precision(text[4:8], motion[4:8], pool=4), [2 / 4, 3 / 4, 3 / 4])
    assert close(r_precision(text, motion, pool=4), [5 / 8, 6 / 8, 6 / 8])
    # a model that says the same to everything knows nothing
    assert close(r_precision(np.ones((64, 3)), np.ones((64, 3))), np.array([1, 2, 3]) / 32)
    # it is the distance that counts, not the angle
    text, motion = np.array([[1.0, 0], [9, 0]]), np.array([[1.0, 1], [9, 1]])
    assert close(r_precision(text, motion, pool=2), 1)


@case(
    m.mm_distance,
    lambda text, motion: np.sqrt(np.square(norm(text - motion)).mean()),
    lambda text, motion: norm(text[:, None] - motion).mean(),
    lambda text, motion: norm(text.mean(0) - motion.mean(0)),
    lambda text, motion: np.abs(text - motion).mean(),
)
def check_mm_distance(mm_distance):
    text = np.array([[0.0, 0], [1, 1], [2, 2]])
    assert close(mm_distance(text, text + [[3, 4], [0, 0], [-6, 8]]), (5 + 0 + 10) / 3)


def covariances(a, b, ddof=1):
    return np.cov(a.T, ddof=ddof), np.cov(b.T, ddof=ddof)


def root_of(c):
    values, vectors = np.linalg.eigh(c)
    return vectors * np.sqrt(values.clip(0)) @ vectors.T


def frechet(a, b, ddof=1, overlap=lambda ca, cb: np.linalg.norm(root_of(ca) @ root_of(cb), "nuc")):
    ca, cb = covariances(a, b, ddof)
    return np.square(a.mean(0) - b.mean(0)).sum() + np.trace(ca + cb) - 2 * overlap(ca, cb)


def exactly(mean, covariance, count):
    """A sample (count,E) whose mean and ddof-1 covariance are exactly these."""
    x = rng(3).normal(size=(count, len(mean)))
    x -= x.mean(0)
    white = x @ np.linalg.inv(np.linalg.cholesky(np.cov(x.T))).T
    return white @ np.linalg.cholesky(covariance).T + mean


@case(
    m.frechet_distance,
    lambda a, b: frechet(a, b, ddof=0),
    lambda a, b: frechet(a, b, overlap=lambda ca, cb: np.trace(root_of(ca) @ root_of(cb))),
    lambda a, b: frechet(a, b, overlap=lambda ca, cb: np.sqrt(np.diag(ca) * np.diag(cb)).sum()),
    lambda a, b: frechet(a, b) - np.square(a.mean(0) - b.mean(0)).sum(),
    lambda a, b: frechet(a, b, overlap=lambda ca, cb: np.trace(ca @ cb)),
    lambda a, b: math.sqrt(max(frechet(a, b), 0)),
)
def check_frechet_distance(frechet_distance):
    zero, a = np.zeros(2), np.array([[2.0, 0.3], [0.3, 1.0]])
    # commuting covariances: the squared distance of the means and of the deviations
    x, y = exactly(zero, np.diag([4.0, 9.0]), 8), exactly(np.array([1.0, 2.0]), np.diag([1.0, 25.0]), 11)
    assert close(frechet_distance(x, y), 1 + 4 + (2 - 1) ** 2 + (3 - 5) ** 2)
    # of any two by two: Tr sqrt(A B) = sqrt(Tr(A B) + 2 sqrt(det A det B))
    b = np.array([[1.0, -0.8], [-0.8, 3.0]])
    trace = math.sqrt(np.trace(a @ b) + 2 * math.sqrt(np.linalg.det(a) * np.linalg.det(b)))
    x, y = exactly(zero, a, 20), exactly(zero, b, 30)
    assert close(frechet_distance(x, y), np.trace(a + b) - 2 * trace)
    assert close(frechet_distance(x, y), frechet_distance(y, x)) and close(frechet_distance(x, x), 0)
    # fewer motions than dimensions: still no distance from oneself, and moving costs the move
    few = rng().normal(size=(5, 16))
    assert close(frechet_distance(few, few), 0, 1e-7) and close(frechet_distance(few, few + 0.25), 16 / 16, 1e-7)


def test_the_floor_of_fid_is_what_its_bias_predicts():
    """Two draws of N(0, I/64), N = 1,024 each: 0.033 (facts on the metrics, section 1.9)."""
    a, b = rng().normal(0, 1 / 8, (2, 1024, 64))
    assert abs(m.frechet_distance(a, b) - 0.033) < 0.002
    assert m.frechet_distance(a[:, 0:1], b[:, 0:1]) < 0.001  # one dimension works


def self_pairs(motion, rng, pairs=300):
    size = min(pairs, len(motion))
    return norm(motion[rng.choice(len(motion), size)] - motion[rng.choice(len(motion), size)]).mean()


@case(
    m.diversity,
    self_pairs,
    lambda motion, rng, pairs=300: m.diversity(motion, rng, pairs) ** 2,
    lambda motion, rng, pairs=300: norm(motion - motion.mean(0)).mean(),
    lambda motion, rng, pairs=300: norm(np.diff(motion, axis=0)).mean(),
)
def check_diversity(diversity):
    assert close(diversity(np.eye(40), rng()), math.sqrt(2))  # one-hot rows are all as far apart
    few = np.array([0.0, 1, 3, 7])[:, None]  # gaps 1, 3, 7, 2, 6, 4: all are taken, whatever the seed
    assert all(close(diversity(few, rng(seed)), 23 / 6) for seed in range(3))


def test_diversity_of_a_gaussian_and_how_many_pairs_it_reads():
    """|x - y| of two standard normals in the plane: mean sqrt(pi), deviation sqrt(4 - pi)."""
    motion = rng().normal(size=(20_000, 2))
    for count, pairs in ((20_000, 300), (300, 100)):
        scores = [m.diversity(motion[:count], rng(seed)) for seed in range(300)]
        assert abs(np.mean(scores) - math.sqrt(math.pi)) < 0.08
        assert abs(np.std(scores) * math.sqrt(pairs) / math.sqrt(4 - math.pi) - 1) < 0.15
    assert m.diversity(motion, rng(5)) == m.diversity(motion, rng(5)) != m.diversity(motion, rng(6))


def each_text_its_own_pairs(motion, rng, pairs=10):
    return np.mean([m.multimodality(one[None], rng, pairs) for one in motion])


@case(
    m.multimodality,
    lambda motion, rng, pairs=10: m.diversity(motion.reshape(-1, motion.shape[-1]), rng),
    lambda motion, rng, pairs=10: np.mean([self_pairs(one, rng, pairs) for one in motion]),
    lambda motion, rng, pairs=10: m.multimodality(motion.swapaxes(0, 1), rng, pairs),
    each_text_its_own_pairs,
)
def check_multimodality(multimodality):
    motion = np.array([[[0.0, 0], [0, 2]], [[100, 0], [106, 8]]])  # (2 texts, 2 samples, 2)
    assert all(close(multimodality(motion, rng(seed)), (2 + 10) / 2) for seed in range(3))
    # the pairs are the same for all texts: a text ten times as varied adds ten times as much
    one = rng().normal(size=(1, 30, 3))
    assert close(multimodality(np.concatenate([one, 10 * one]), rng(1)), 5.5 * multimodality(one, rng(1)))


@case(
    m.clip_score,
    lambda text, motion: (text * motion).sum(1).mean(),
    lambda text, motion: 2.5 * max(m.clip_score(text, motion), 0.0),
    lambda text, motion: max(m.clip_score(text, motion), 0.0),
    lambda text, motion: m.clip_score(text.mean(0, keepdims=True), motion.mean(0, keepdims=True)),
    m.tmr_score,
)
def check_clip_score(clip_score):
    text, motion = np.array([[3.0, 4], [1, 0]]), np.array([[8.0, 6], [0, 7]])
    assert close(clip_score(text, motion), (48 / 50 + 0) / 2)
    assert close(clip_score(text, -motion), -0.48)


@case(
    m.tmr_score,
    m.clip_score,
    lambda a, b: (np.abs(m.clip_score(a, b)) + 1) / 2,
    lambda a, b: m.clip_score(a, b) / 2 + 1,
    lambda a, b: ((a * b).sum(1).mean() + 1) / 2,
)
def check_tmr_score(tmr_score):
    text, motion = np.array([[3.0, 4], [1, 0]]), np.array([[8.0, 6], [0, 7]])
    assert close(tmr_score(text, motion), (0.98 + 0.5) / 2)
    assert close(tmr_score(text, -motion), (0.02 + 0.5) / 2) and close(tmr_score(text, 5 * text), 1)


# --- Joints ---------------------------------------------------------------------------------------------------------


@case(
    m.mpjpe,
    lambda a, b, root_align=True: norm(a - b).mean(),
    lambda a, b, root_align=True: m.mpjpe(a - a[:, :1] * root_align, b - b[:1, :1] * root_align, False),
    lambda a, b, root_align=True: np.sqrt(np.square(norm((a - b) - (a - b)[:, :1] * root_align)).mean()),
    lambda a, b, root_align=True: np.abs((a - b) - (a - b)[:, :1] * root_align).mean(),
    lambda a, b, root_align=True: m.mpjpe(a, b),
    lambda a, b, root_align=True: m.pa_mpjpe(a, b),
)
def check_mpjpe(mpjpe):
    a = motion(4)
    b = a.copy()
    b[2, 5] += [0.3, 0.0, -0.4]  # one joint in one of four frames
    assert close(mpjpe(a, b), 0.5 / (4 * 22)) and close(mpjpe(a, b, root_align=False), 0.5 / (4 * 22))
    shift = rng().normal(size=(4, 1, 3))
    assert close(mpjpe(a, b + shift), 0.5 / (4 * 22))
    assert close(mpjpe(a, a + shift, root_align=False), norm(shift).mean())
    half = ft.turn(a, np.full(4, np.pi))  # turning is an error: each joint goes to the other side of the axis
    assert close(mpjpe(a, half), 2 * norm((a - a[:, :1])[..., [0, 2]]).mean())


def moved(x, seed=0):
    """Every frame (T,22,3) turned, scaled and moved at random."""
    r = rng(seed)
    turns = sk.quat_to_matrix(sk.normalize(r.normal(size=(len(x), 4))))
    return r.uniform(0.5, 2, (len(x), 1, 1)) * x @ turns + r.normal(size=(len(x), 1, 3))


def procrustes(a, b, scaled=True, reflect=False):
    a, b = a - a.mean(1, keepdims=True), b - b.mean(1, keepdims=True)
    u, s, vt = np.linalg.svd(a.transpose(0, 2, 1) @ b)
    flip = np.ones_like(s)
    if not reflect:
        flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    scale = (s * flip).sum(1) / np.square(a).sum((1, 2)) if scaled else np.ones(len(a))
    return norm(scale[:, None, None] * (a @ (u * flip[:, None]) @ vt) - b).mean()


def whole_clip(a, b):
    flat = [x.reshape(1, -1, 3) for x in (a, b)]
    return procrustes(*flat)


@case(
    m.pa_mpjpe,
    lambda a, b: procrustes(a, b, scaled=False),
    lambda a, b: procrustes(a, b, reflect=True),
    lambda a, b: m.pa_mpjpe(b, a),
    whole_clip,
    m.mpjpe,
)
def check_pa_mpjpe(pa_mpjpe):
    a = motion(3)
    assert pa_mpjpe(moved(a), a) < 1e-9
    # x has orthonormal columns that sum to 0, and z is square to them, so the best turn of x to x diag(3,2,1) + z is
    # none and the best scale is the mean, 2. What is left is x diag(1,0,-1) + z.
    q = np.linalg.qr(np.column_stack([np.ones(22), rng().normal(size=(22, 6))]))[0]
    x, z = q[None, :, 1:4], 0.1 * q[None, :, 4:7]
    left = norm(x * [1, 0, -1] + z).mean()
    assert close(pa_mpjpe(moved(x), x * [3, 2, 1] + z), left)
    # no turn makes a left hand of a right one: along the cheapest axis x stays wrong, scale (3 + 2 - 1) / 3
    left = norm(4 / 3 * x * [1, 1, -1] - x * [3, 2, 1]).mean()
    assert close(pa_mpjpe(moved(x * [1, 1, -1]), x * [3, 2, 1]), left)
    assert close(pa_mpjpe(np.ones((1, 22, 3)), x), norm(x).mean())  # a body in one point stays one


@case(
    m.accel,
    lambda a, b: m.accel(a - a[:, :1], b - b[:, :1]),
    lambda a, b: m.accel(a, b) * sk.FPS**2,
    lambda a, b: norm(np.diff(a - b, axis=0)).mean(),
    lambda a, b: np.abs(norm(np.diff(a, 2, axis=0)) - norm(np.diff(b, 2, axis=0))).mean(),
    lambda a, b: np.abs(np.diff(a - b, 2, axis=0)).sum(-1).mean(),
)
def check_accel(accel):
    a, t = motion(9), np.arange(9.0)[:, None, None]
    assert close(accel(a, a + t * [1, 2, 3] + 5), 0)  # a steady drift is no acceleration
    assert close(accel(a, a + t**2 / 2 * [0.03, 0, 0.04]), 0.05)
    assert close(accel(a, -a), 2 * norm(a[2:] - 2 * a[1:-1] + a[:-2]).mean())


def third(windows):
    return np.diff(windows, 3, axis=1)


@case(
    m.jerk_curve,
    lambda w: m.jerk_curve(w) * sk.FPS**3,
    lambda w: norm(third(w)).max(-1).mean(0),
    lambda w: np.abs(third(w)).sum(-1).mean((0, 2)),
    lambda w: np.abs(third(w)).sum(-1).max((0, 2)),
    lambda w: np.abs(np.diff(w, 2, axis=1)).sum(-1).max(-1).mean(0)[1:],
)
def check_jerk_curve(jerk_curve):
    still = np.tile(motion(1), (3, 10, 1, 1))
    assert jerk_curve(still).shape == (7,) and close(jerk_curve(still), 0)
    jump = still.copy()
    jump[:, 5:, 7] += [0.06, 0.0, -0.04]  # 10 cm in L1, one joint of 22
    assert close(jerk_curve(jump), [0, 0, 0.1, 0.2, 0.1, 0, 0])
    assert close(jerk_curve(np.concatenate([jump, still])), np.array([0, 0, 0.1, 0.2, 0.1, 0, 0]) / 2)
    cubic = still + (np.arange(10) ** 3)[:, None, None] * np.array([0.01, 0.02, 0.03])
    assert close(jerk_curve(cubic), 6 * 0.06)  # the third difference of t^3 is 6


@case(
    m.peak_jerk,
    lambda w: np.mean([m.jerk_curve(one[None]).max() for one in w]),
    lambda w: m.jerk_curve(w).mean(),
    lambda w: m.jerk_curve(w)[(w.shape[1] - 3) // 2],
)
def check_peak_jerk(peak_jerk):
    windows = np.tile(motion(1), (2, 12, 1, 1))
    assert peak_jerk(windows) == 0
    windows[0, 4:] += [0.1, 0, 0]
    assert close(peak_jerk(windows[:1]), 0.2)
    windows[1, 9:] += [0.1, 0, 0]
    assert close(peak_jerk(windows), 0.1)  # spikes at different times average out


@case(
    m.area_under_jerk,
    lambda w, reference: abs((m.jerk_curve(w) - reference).sum()),
    lambda w, reference: m.jerk_curve(w).sum(),
    lambda w, reference: np.abs(m.jerk_curve(w) - reference).mean(),
    lambda w, reference: np.mean([m.area_under_jerk(one[None], reference) for one in w]),
)
def check_area_under_jerk(area_under_jerk):
    windows = np.tile(motion(1), (2, 60, 1, 1))
    assert close(area_under_jerk(windows, 0.033031363), 1.8828, 1e-4)  # 57 times the constant: stillness is not free
    windows[0, 30:] += [0.2, 0, 0]  # mean curve .1, .2, .1 and 54 zeros
    assert close(area_under_jerk(windows, 0.15), 0.05 + 0.05 + 0.05 + 54 * 0.15)


def jump_in(joints, boundaries, root=lambda j: j[:, :1], heading=ft.facing_yaw, before=1):
    pose = ft.turn(joints - root(joints), -heading(joints))
    cuts = np.unique(boundaries)
    return norm(pose[cuts] - pose[cuts - before]).mean() * 100


@case(
    m.transition_distance,
    lambda j, k: jump_in(j, k, root=lambda j: j[:, :, :1]),  # the released script's own slip
    lambda j, k: jump_in(j, k, root=lambda j: 0),
    lambda j, k: jump_in(j, k, heading=lambda j: np.zeros(len(j))),
    lambda j, k: jump_in(j, k, before=-1),
    lambda j, k: jump_in(j, k) / 100,
    lambda j, k: jump_in(j, range(1, len(j))),
    lambda j, k: norm((np.diff(j - j[:, :1], axis=0))[np.sort(k) - 1]).mean() * 100,
)
def check_transition_distance(transition_distance):
    joints = np.tile(motion(1), (12, 1, 1))
    joints[4:, 20] += [0.22, 0, 0]  # a wrist, 22 cm in frame 4: on average a joint moves 1 cm
    joints[8:, 21] += [0, 0.33, 0.44]  # the other one, 55 cm: 2.5 cm
    joints[10:, 15] += [0, 0.1, 0]
    for clip in (joints, seen_differently(joints)):  # where and how the body goes meanwhile is all the same
        assert close(transition_distance(clip, [4]), 1) and close(transition_distance(clip, [8, 4, 8]), 1.75)
        assert close(transition_distance(clip, [5, 7]), 0)


def skating(joints, height=0.05, speed=0.5, window=5, contact=np.logical_and, axes=(0, 2), fps=20):
    feet = joints[:, [10, 11]]
    v = norm(np.diff(feet[..., list(axes)], axis=0)) * fps
    mean = np.stack([np.convolve(c, np.ones(window) / window, "same") for c in v.T], -1)
    low = feet[..., 1] < height
    return (contact(low[:-1], low[1:]) & (v > speed) & (mean > speed)).any(1).mean()


@case(
    m.skating_ratio,
    lambda j: skating(j, window=1),
    lambda j: skating(j, contact=np.logical_or),
    lambda j: skating(j, speed=0.2),
    lambda j: skating(j, axes=(0, 1, 2)),
    lambda j: skating(j, height=1.0),
    lambda j: skating(j, fps=30),
    lambda j: skating(j[:, np.r_[:10, 10, 10, 12:22]]),
)
def check_skating_ratio(skating_ratio):
    def clip(left=0.0, right=0.0, height=0.0):
        """Feet at this height (T,), moving this far along Z in each of 20 steps (m/s)."""
        joints = np.tile(motion(1), (21, 1, 1))
        joints[:, [10, 11], 1] = np.reshape(height, (-1, 1))
        for foot, speed in ((10, left), (11, right)):
            joints[1:, foot, 2] += np.cumsum(np.broadcast_to(speed, 20)) / 20
        return joints

    steps = np.arange(20)
    assert skating_ratio(clip()) == 0 and skating_ratio(clip(right=0.4)) == 0
    assert skating_ratio(clip(right=1.0)) == 1 and skating_ratio(clip(left=-1.0)) == 1
    assert skating_ratio(clip(right=0.8)) == 18 / 20  # at both ends the mean is over 3 of 5: .48
    assert skating_ratio(clip(left=0.8 * (steps < 10), right=0.8 * (steps >= 10))) == 16 / 20
    assert skating_ratio(clip(right=2.0 * (steps == 9))) == 0  # 2 m/s, but .4 around it
    assert skating_ratio(clip(right=1.0, height=0.06)) == 0
    assert skating_ratio(clip(right=1.0, height=np.where(np.arange(21) == 9, 0.06, 0.0))) == 18 / 20  # into, out of
    up = np.arange(21) % 2 * 0.02  # 0, 2 cm, 0, 2 cm: .4 m/s up and down, which is not sliding
    assert skating_ratio(clip(right=0.45, height=up)) == 0
    assert skating_ratio(clip(right=1.0)[:2]) == 1 * (1 / 5 > 0.5)  # a single step is too short to skate in


# --- Programs and repeats -------------------------------------------------------------------------------------------

WALK, JUMP, SIT = Segment("walk", speed="slow"), Segment("jump", count=2), Segment("sit")
ASKED = [(WALK, JUMP), (SIT,)]


def per_clip(asked, found):
    return np.mean([m.segment_accuracy([a], [f]) for a, f in zip(asked, found)])


def of_asked(asked, found):
    return m.segment_accuracy(asked, [f[: len(a)] for a, f in zip(asked, found)])


@case(m.segment_accuracy, per_clip, of_asked, lambda a, f: m.segment_accuracy(f, a), m.clip_accuracy)
def check_segment_accuracy(segment_accuracy):
    assert segment_accuracy(ASKED, ASKED) == 1
    # right: walk and sit; of two asked in the first and two found in the second
    assert segment_accuracy(ASKED, [(WALK, replace(JUMP, count=3)), (SIT, WALK)]) == 2 / 4
    assert segment_accuracy(ASKED, [(WALK, JUMP), ()]) == 2 / 3
    assert segment_accuracy(ASKED, [(JUMP, WALK), (SIT,)]) == 1 / 3  # order counts
    assert segment_accuracy([(replace(WALK, speed=None),)], [(WALK,)]) == 1  # not stated, not graded


@case(m.clip_accuracy, m.segment_accuracy, lambda a, f: np.mean([x == y for x, y in zip(a, f)]), of_asked)
def check_clip_accuracy(clip_accuracy):
    assert clip_accuracy(ASKED, ASKED) == 1
    assert clip_accuracy(ASKED, [(WALK, SIT), (SIT,)]) == 1 / 2
    assert clip_accuracy(ASKED, [(WALK, JUMP), (SIT, WALK)]) == 1 / 2  # one too many
    assert clip_accuracy([(replace(WALK, speed=None),)], [(WALK,)]) == 1


@case(
    m.field_accuracy,
    lambda a, f: m.field_accuracy(f, a),
    lambda a, f: m.field_accuracy([x[: len(y)] for x, y in zip(a, f)], [y[: len(x)] for x, y in zip(a, f)]),
    lambda a, f: {name: 1.0 for name in m.field_accuracy(a, f)},
)
def check_field_accuracy(field_accuracy):
    assert field_accuracy([(WALK,)], [(replace(WALK, speed="fast"),)]) == {"action": 1, "speed": 0}
    assert field_accuracy([(WALK, JUMP)], [(WALK,)]) == {"action": 0.5, "speed": 1, "count": 0}
    assert field_accuracy([(SIT,)], [(WALK,)]) == {"action": 0}  # found, but not asked


@case(
    m.confidence,
    lambda v: (np.mean(v), 1.96 * np.std(v, ddof=len(v) > 1) / math.sqrt(len(v))),
    lambda v: (np.mean(v), 1.96 * np.std(v)),
    lambda v: (np.median(v), m.confidence(v)[1]),
    lambda v: (np.mean(v), np.std(v) / math.sqrt(len(v))),
)
def check_confidence(confidence):
    # mean 4, squared gaps 9, 1, 1, 9: variance 5 over n, so 1.96 sqrt(5 / 4)
    assert close(confidence([1, 3, 5, 7]), (4, 1.96 * math.sqrt(5) / 2))
    assert close(confidence([0, 0, 3]), (1, 1.96 * math.sqrt(2) / math.sqrt(3)))
    assert confidence([0.25]) == (0.25, 0.0)


# --- All of them ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("check, right", [c[:2] for c in CASES], ids=[c[0].__name__ for c in CASES])
def test_right(check, right):
    check(right)


WRONG = [(check, mutant, f"{check.__name__}-{k}") for check, _, mutants in CASES for k, mutant in enumerate(mutants)]


@pytest.mark.parametrize("check, mutant", [w[:2] for w in WRONG], ids=[w[2] for w in WRONG])
def test_a_mutant_is_rejected(check, mutant):
    with pytest.raises(AssertionError):
        check(mutant)


def test_every_metric_has_a_check_and_two_mutants():
    names = {
        n for n, f in vars(m).items() if callable(f) and getattr(f, "__module__", "") == m.__name__ and n[0] != "_"
    }
    assert {right.__name__ for _, right, _ in CASES} == names and len(names) == 19
    assert all(len(mutants) >= 2 for _, _, mutants in CASES)


def test_retrieval_equals_a_sorted_list_and_survives_a_shuffle():
    text = rng().normal(size=(70, 5))
    motion = text + rng(1).normal(size=(70, 5))
    ranks = []
    for i in range(64):
        pool = range(i // 32 * 32, i // 32 * 32 + 32)
        ranks.append(sorted(pool, key=lambda j: math.dist(text[i], motion[j])).index(i))
    expected = [np.mean([rank < k for rank in ranks]) for k in (1, 2, 3)]
    assert close(m.r_precision(text, motion), expected)
    shuffled = [m.r_precision(text, motion, rng=rng(seed)) for seed in (0, 0, 1)]
    assert close(shuffled[0], shuffled[1]) and not close(shuffled[0], shuffled[2])
    assert close(m.r_precision(text, motion, 70, rng()), m.r_precision(text, motion, 70))  # one pool: order is nothing


def test_chance():
    text, motion = rng().normal(size=(2, 3200, 4))
    assert np.abs(m.r_precision(text, motion) - np.array([1, 2, 3]) / 32).max() < 0.012  # 3 standard errors


def test_float32_goes_in_and_float64_comes_out():
    near = 1000 + rng().normal(size=(32, 8)).astype(np.float32)
    assert m.mm_distance(near, near) == 0 and close(m.r_precision(near, near), 1)
    assert isinstance(m.mm_distance(near, near), float) and m.r_precision(near, near).dtype == np.float64
    assert m.jerk_curve(motion()[None].astype(np.float32)).dtype == np.float64


E, J, W = np.ones((8, 4)), np.ones((8, 22, 3)), np.ones((2, 8, 22, 3))
BAD = {
    "pool larger than N": (lambda: m.r_precision(E, E), "pool of 32 .* N = 8"),
    "empty pool": (lambda: m.r_precision(E, E, pool=0), "pool of 0"),
    "pairs of two lengths": (lambda: m.mm_distance(E, E[:3]), "text and motion .* one shape"),
    "a vector": (lambda: m.clip_score(E[0], E[0]), r"text must have shape \(N, E\)"),
    "a zero": (lambda: m.clip_score(E, E * 0), "zero embedding"),
    "no pairs": (lambda: m.tmr_score(E[:0], E[:0]), "nothing empty"),
    "one motion": (lambda: m.frechet_distance(E[:1], E), "N >= 2"),
    "two widths": (lambda: m.frechet_distance(E, E[:, :2]), r"b must have shape \(M >= 2, 4\)"),
    "alone": (lambda: m.diversity(E[:1], rng()), "N >= 2"),
    "one sample": (lambda: m.multimodality(W[:, :1, 0], rng()), "samples >= 2"),
    "no pair": (lambda: m.diversity(E, rng(), pairs=0), "at least 1"),
    "20 joints": (lambda: m.mpjpe(J[:, 2:], J[:, 2:]), r"\(T, 22, 3\).*\(8, 20, 3\)"),
    "two frames": (lambda: m.accel(J[:2], J[:2]), "T >= 3"),
    "lengths": (lambda: m.pa_mpjpe(J, J[1:]), "one shape"),
    "three frames": (lambda: m.peak_jerk(W[:, :3]), "L >= 4"),
    "a clip as windows": (lambda: m.jerk_curve(J), "windows must have shape"),
    "a list as reference": (lambda: m.area_under_jerk(W, [0.1, 0.2]), "reference must have shape"),
    "boundary at 0": (lambda: m.transition_distance(J, [0]), "from 1 to 7"),
    "boundary at T": (lambda: m.transition_distance(J, [3, 8]), "from 1 to 7"),
    "no boundary": (lambda: m.transition_distance(J, []), "at least one"),
    "half a frame": (lambda: m.transition_distance(J, [2.5]), "boundaries must be frames"),
    "NaN": (lambda: m.skating_ratio(J * np.nan), "joints must be finite"),
    "infinity": (lambda: m.confidence([1.0, np.inf]), "values must be finite"),
    "nothing": (lambda: m.confidence([]), "nothing empty"),
    "two counts": (lambda: m.segment_accuracy(ASKED, ASKED[:1]), "pairs of programs"),
}


@pytest.mark.parametrize("call, message", BAD.values(), ids=BAD)
def test_errors_teach(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_arrows():
    assert m.ARROWS["fid"] == m.ARROWS["mpjpe_mm"] == "↓" and m.ARROWS["diversity"] == m.ARROWS["pj"] == "→"
    keys = (
        "oracle_accuracy oracle_accuracy_heldout r_at_1 r_at_2 r_at_3 mm_dist fid diversity multimodality clip_score "
    )
    keys += "skating_ratio mpjpe_mm pa_mpjpe_mm accel_mm pj auj transition_fid transition_distance_cm m2t m2m "
    keys += "segments_found"
    assert set(m.ARROWS) == set(keys.split())


def test_the_quick_protocol_scores_with_these_functions():
    assert quick.segment_accuracy is m.segment_accuracy and quick.clip_accuracy is m.clip_accuracy


@pytest.mark.parametrize("name", ["torch", "scipy"])
def test_metrics_need_numpy_alone(name):
    code = f"import sys, minicmdm.evaluation.metrics; print({name!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


@needs_reference
def test_on_a_real_clip_they_give_the_numbers_of_the_fields_own_codes():
    """Facts on the metrics, section 4: taken there from the released codes (1 cm of noise for the errors)."""
    joints = np.load(REFERENCE / "012314_joints.npy")
    noisy = joints + rng().normal(0, 0.01, joints.shape)
    assert abs(m.mpjpe(joints, noisy) - 0.02161) < 1e-4
    assert abs(m.pa_mpjpe(noisy, joints) - 0.01505) < 1e-4
    assert abs(m.accel(joints, noisy) - 0.03918) < 2e-4
    assert close(m.skating_ratio(joints), 23 / 169)  # .136
    assert round(m.transition_distance(joints, range(1, len(joints))), 2) == 2.41
