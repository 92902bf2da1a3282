"""Wrong answers to the exercises of notebook 11."""

import numpy as np

from minicmdm.data.features import canonicalize, facing_yaw, turn


def third(windows, n=3):
    return np.diff(windows, n=n, axis=1)


def cut(joints, seams, length):
    starts = [k - length // 2 for k in seams]
    return [joints[k : k + length] for k in starts if k >= 0 and k + length <= len(joints)]


def stacked(windows, length):
    return np.array(list(windows)).reshape(-1, length, 22, 3)


def from_the_seam(joints, seams, length):
    windows = [joints[k : k + length] for k in seams if k + length <= len(joints)]
    return stacked(map(canonicalize, windows), length)


def past_the_start(joints, seams, length):
    starts = [max(k - length // 2, 0) for k in seams]
    return stacked([canonicalize(joints[k : k + length]) for k in starts if k + length <= len(joints)], length)


def only_moved(joints, seams, length):
    return stacked([x - x[:1, :1] * [1, 0, 1] for x in cut(joints, seams, length)], length)


def every_frame(joints, seams, length):
    windows = [turn(x - x[:, :1] * [1, 0, 1], -facing_yaw(x)) for x in cut(joints, seams, length)]
    return stacked(windows, length)


def in_place(joints, seams, length):
    joints -= joints[:1, :1] * [1, 0, 1]  # spoils the reader's motion
    return stacked(map(canonicalize, cut(joints, seams, length)), length)


def jump(pose, seams, scale=100, back=1, **norm):
    cuts = np.unique(seams)
    return scale * np.linalg.norm(pose[cuts] - pose[cuts - back], axis=-1, **norm).mean()


def posed(joints):
    return turn(joints - joints[:, :1], -facing_yaw(joints))


MUTANTS = {
    "11.1": [
        lambda w: np.abs(third(w)).sum(-1).mean(-1).mean(0),  # the mean joint
        lambda w: np.abs(third(w)).sum(-1).mean(0).max(-1),  # windows before joints
        lambda w: np.linalg.norm(third(w), axis=-1).max(-1).mean(0),  # L2
        lambda w: np.abs(third(w, 2)).sum(-1).max(-1).mean(0),  # acceleration
        lambda w: np.abs(third(w)).sum(-1).max(-1),  # a curve for each window
        lambda w: third(w).sum(-1).max(-1).mean(0),  # no absolute value
        lambda w: 20**3 * np.abs(third(w)).sum(-1).max(-1).mean(0),  # per second cubed
    ],
    "11.2": [
        from_the_seam,
        past_the_start,  # moved inside instead of left out
        only_moved,  # not turned
        every_frame,  # each frame at the origin
        in_place,
        lambda joints, seams, length: stacked(cut(joints, seams, length), length),  # where they were
        lambda joints, seams, length: stacked(cut(canonicalize(joints), seams, length), length),  # stood once, for all
        lambda joints, seams, length: stacked(
            [canonicalize(x, floor=True) for x in cut(joints, seams, length)], length
        ),
    ],
    "11.3": [
        lambda joints, seams: jump(joints - joints[:, :, :1], seams),  # the x coordinate: STMC's script
        lambda joints, seams: jump(joints - joints[:, :1], seams),  # heading left on
        lambda joints, seams: jump(
            turn(joints - joints[:, :1] * [1, 0, 1], -facing_yaw(joints)), seams
        ),  # height left on
        lambda joints, seams: jump(posed(joints), seams, scale=1),  # metres
        lambda joints, seams: jump(turn(joints, -facing_yaw(joints)), seams),  # the pelvis left on
        lambda joints, seams: (
            100 * np.abs(posed(joints)[seams] - posed(joints)[np.array(seams) - 1]).mean()
        ),  # L1, by coordinate
        lambda joints, seams: 100 * np.linalg.norm(np.diff(posed(joints), axis=0), axis=-1).mean(),  # all frames
    ],
}
