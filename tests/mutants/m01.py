"""Wrong answers to the exercises of notebook 01."""

import numpy as np

from minicmdm.data.features import mirror_joints, turn
from minicmdm.exercises.n01 import GROUPS


def statistics(clips, mean=None, shared=lambda clip, own: own.mean(), least=1e-4, groups=GROUPS):
    stacked = np.concatenate(clips)
    own, std = stacked.std(0), stacked.std(0)
    for a, b in groups:
        std[a:b] = max(shared(stacked[:, a:b], own[a:b]), least)
    return (stacked.mean(0) if mean is None else mean), std


def path(root, half=2, sign=-1, shift=1, last=False, back=False):
    yaw = np.zeros(len(root))
    angles = sign * half * np.cumsum(root[:, 0])
    yaw[shift:] = angles[: len(root) - shift]
    steps = np.zeros((len(root), 3))
    steps[1:, [0, 2]] = root[1:, 1:3] if last else root[:-1, 1:3]
    out = np.cumsum(turn(steps, -yaw if back else yaw), axis=0)
    out[:, 1] = root[:, 3]
    return out


def from_the_old_heading(root):  # turns step t by the heading of t, not of t+1
    yaw = np.concatenate([[0.0], -2 * np.cumsum(root[:, 0])])[: len(root)]
    steps = turn(np.stack([root[:, 1], 0 * yaw, root[:, 2]], -1), yaw)
    out = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])[: len(root)]
    out[:, 1] = root[:, 3]
    return out


def without_shift(root):  # frame 0 has already taken its first step
    out = np.cumsum(turn(np.stack([root[:, 1], 0 * root[:, 0], root[:, 2]], -1), -2 * np.cumsum(root[:, 0])), 0)
    out[:, 1] = root[:, 3]
    return out


def in_place(joints):
    joints[..., 0] *= -1
    return mirror_joints(joints) * [-1, 1, 1]


MUTANTS = {
    "01.1": [
        lambda clips: (np.concatenate(clips).mean(0), np.concatenate(clips).std(0)),  # each feature its own std
        lambda clips: statistics(clips, mean=np.mean([clip.mean(0) for clip in clips], axis=0)),  # mean of means
        lambda clips: statistics(clips, shared=lambda clip, own: clip.std()),  # one std of all numbers of a group
        lambda clips: statistics(clips, least=0.0),  # divides by zero
        lambda clips: statistics(clips, groups=[(0, 4), *GROUPS[3:]]),  # the root as one group
        lambda clips: statistics(clips, groups=[(0, 263)]),
        lambda clips: tuple(value.mean(0, keepdims=True) for value in np.stack(statistics(clips))[:, None, None]),
        lambda clips: statistics(clips[:1]),  # one clip speaks for all
    ],
    "01.2": [
        lambda root: path(root, half=1),  # a whole angle
        lambda root: path(root, sign=1),  # to the right
        lambda root: path(root, back=True),
        lambda root: path(root, last=True),  # the row of the frame it leads to
        from_the_old_heading,
        without_shift,
        lambda root: path(root) * [1, 0, 1],  # no height
        lambda root: np.cumsum(np.stack([root[:, 1], root[:, 3], root[:, 2]], -1), 0),  # sums the heights too
        lambda root: path(root * [0, 1, 1, 1]),  # never turns
    ],
    "01.3": [
        lambda joints: joints * [-1, 1, 1],  # a left hand in the mirror stays a left hand
        lambda joints: mirror_joints(joints) * [-1, 1, 1],  # swaps, and does not reflect
        lambda joints: mirror_joints(joints) * [-1, 1, -1],  # reflects along z
        lambda joints: joints[:, ::-1] * [-1, 1, 1],
        lambda joints: np.concatenate([mirror_joints(joints)[:, :16], joints[:, 16:] * [-1, 1, 1]], 1),  # no arms
        in_place,
    ],
}
