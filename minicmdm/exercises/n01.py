"""The exercises of notebook 01: statistics of the features, the root's path, a motion in the mirror."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from minicmdm.data.dataset import feature_statistics
from minicmdm.data.features import NUM_ESSENTIAL, facing_yaw, features_to_joints, mirror_joints, turn
from minicmdm.data.skeleton import JOINT_NAMES, LEFT_RIGHT
from minicmdm.exercises.frame import Exercise, must, sizes

GROUPS = ((0, 1), (1, 3), (3, 4), (4, 67), (67, 193), (193, 259), (259, 263))


def _prove_statistics(answer: Callable) -> None:
    rng = np.random.default_rng(0)
    for lengths in ([2], [1, 3], [5, 20], [4, 9, 30], [60, 7, 11, 2]):
        clips = [rng.normal(rng.normal(size=263), rng.uniform(0.5, 2, 263), (length, 263)) for length in lengths]
        for clip in clips:
            clip[:, 259:] = 1.0  # feet that never move
        stacked = np.concatenate(clips)
        mean, std = (np.asarray(value) for value in answer([clip.copy() for clip in clips]))
        must(mean.shape == std.shape == (263,), "Mean and std have one number for each feature: (263,).")
        same = np.allclose(mean, stacked.mean(0), rtol=1e-4, atol=1e-5)
        must(same, f"Clips of {lengths} frames: every frame counts as much as any other, in whichever clip it is.")
        must((std > 0).all(), "Feet that never move have a std of 0, and nobody can divide by that: 1e-4 at least.")
        must(np.allclose(std[259:], 1e-4), "Where the std of a group is below 1e-4, 1e-4 takes its place.")
        for a, b in GROUPS[:-1]:
            law = f"Features {a} to {b - 1} are one group: "
            must(np.allclose(std[a:b], std[a]), law + "they share one std, so that none is blown up.")
            wanted = stacked[:, a:b].std(0).mean()
            must(np.allclose(std[a], wanted, rtol=1e-3), law + "the average of their own stds.")


def root_path(root: np.ndarray) -> np.ndarray:
    """Where the pelvis is, (T,3), from the first four features (T,4) of each frame."""
    yaw = np.zeros(len(root))
    yaw[1:] = -2 * np.cumsum(root[:-1, 0])  # half angles, and to the left is negative
    steps = np.zeros((len(root), 3))
    steps[1:, [0, 2]] = root[:-1, 1:3]  # row t leads to frame t+1, seen from the heading there
    path = np.cumsum(turn(steps, yaw), axis=0)
    path[:, 1] = root[:, 3]
    return path


def _prove_path(answer: Callable) -> None:
    rng = np.random.default_rng(0)
    for turns in (False, True):
        for frames in sizes(1, 60, count=6):
            root = np.concatenate([rng.normal(0, 0.3, (frames, 3)), rng.uniform(0.8, 1, (frames, 1))], axis=1)
            root[:, 0] *= turns
            wide = np.concatenate([root, np.zeros((frames, NUM_ESSENTIAL - 4))], axis=1)
            right = features_to_joints(wide)[:, 0]
            path = np.asarray(answer(root.copy()), dtype=float)
            must(path.shape == (frames, 3), f"{frames} rows give {frames} places in space: ({frames}, 3).")
            must(np.allclose(path[:, 1], root[:, 3]), "The height is stored as it is, not as a step.")
            must(np.allclose(path[0, [0, 2]], 0), "Frame 0 stands at x = z = 0: row t is the step from t to t+1.")
            length = np.linalg.norm(np.diff(path[:, [0, 2]], axis=0), axis=-1)
            law = "Turning a step changes its direction, not its length; the last row's step leads out of the clip."
            must(np.allclose(length, np.linalg.norm(root[:-1, 1:3], axis=-1)), law)
            law = "Step t is seen from the heading of t+1, which is -2 times the sum of feature 0 over rows 0 to t."
            must(np.allclose(path, right), law if turns else "Without turns a step is a step along x and z.")


def _prove_mirror(answer: Callable) -> None:
    rng = np.random.default_rng(0)
    for frames in sizes(1, 40, count=4):
        joints = rng.normal(size=(frames, 22, 3))
        given = joints.copy()
        mirrored = np.asarray(answer(given))
        must(np.array_equal(given, joints), "The motion that came must stay as it was: work on a copy.")
        must(mirrored.shape == joints.shape, "The mirror keeps the shape (T, 22, 3).")
        must(np.allclose(mirrored[:, 0], joints[:, 0] * [-1, 1, 1]), "The pelvis at x stands at -x in the mirror.")
        for pair in LEFT_RIGHT:
            for j, other in (pair, pair[::-1]):
                law = f"A mirror's {JOINT_NAMES[j]} is the {JOINT_NAMES[other]} of the one who looks into it."
                must(np.allclose(mirrored[:, j], joints[:, other] * [-1, 1, 1]), law)
        same = np.allclose(mirror_joints(joints), mirrored)
        must(same, "Joints in the middle (spine, neck, head) have no partner: only their x changes.")
        there = np.exp(1j * facing_yaw(mirrored))
        must(np.allclose(there, np.exp(-1j * facing_yaw(joints))), "Who faced left by an angle now faces right by it.")
        must(np.allclose(answer(mirrored), joints), "The mirror of the mirror is the motion itself.")


EXERCISES = (
    Exercise(
        "01.1",
        "put all frames under each other, take mean and std over them, then replace the stds of each group "
        "by their average. One line of np.concatenate, and a loop over GROUPS.",
        feature_statistics,
        _prove_statistics,
    ),
    Exercise(
        "01.2",
        "first the heading of every frame (a cumulative sum, shifted by one, times -2), then the steps turned "
        "by the heading they lead to, then their cumulative sum, and last the heights.",
        root_path,
        _prove_path,
    ),
    Exercise(
        "01.3",
        "a mirror changes the sign of x, and it makes a right hand of a left one: LEFT_RIGHT lists the joints "
        "that change places.",
        mirror_joints,
        _prove_mirror,
    ),
)
