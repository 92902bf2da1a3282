"""Joints to the 263 HumanML3D features and back: what a motion looks like to the model.

A frame of features says how the body moves from where it is, in the body's own heading, so the same step is
the same numbers wherever the walker stands and whichever way the walker faces (Guo et al. 2022):

    0        half the yaw step to the next frame (rad); turning left is negative
    1:3      the root's step to the next frame, x and z in the next heading (m)
    3        the root's height (m)
    4:67     joints 1..21 seen from the root's place on the floor, in this heading (m)
    67:193   rotations of joints 1..21 along the chains, 6D
    193:259  every joint's step to the next frame, in this heading (m)
    259:263  is the left ankle, left foot, right ankle, right foot slow enough to be planted?

T+1 frames of joints make T frames of features, because a step needs a next frame. KIT-ML has the same columns for 21
joints, 251 in all, in its own units and at 12.5 fps; joints are in metres here and there, and an array's shape says
whose it is (`skeleton.skeleton_of`).

Two recipes share these columns. "humanml3d" repeats the released data to the letter, flaws included. The
default, "corrected", is the same idea without them: hips the right way round, an angle smoothed instead of
vectors (a fast spin cannot cancel itself), no forced first heading, a half angle that never flips its sign,
and rotations seen from the heading like everything else.
"""

from __future__ import annotations

import re

import numpy as np

from minicmdm.data.skeleton import (
    BONE_LENGTHS,
    JOINT_NAMES,
    LEVELS,
    NUM_JOINTS,
    PARENTS,
    SKELETONS,
    SMPL22,
    Skeleton,
    normalize,
    quat_between,
    quat_inverse,
    quat_multiply,
    quat_yaw,
    skeleton_of,
)

NUM_FEATURES, NUM_ESSENTIAL, NUM_COORDINATES = 263, 67, 66  # of HumanML3D
ROOT_ANGULAR, ROOT_LINEAR, ROOT_HEIGHT = slice(0, 1), slice(1, 3), slice(3, 4)
POSITIONS, ROTATIONS, VELOCITIES, CONTACTS = SMPL22.blocks
HEADINGS = ("corrected", "humanml3d")
CONTACT_JOINTS, CONTACT_THRESHOLD = SMPL22.contact_joints, SMPL22.contact_threshold
SIGMA, RADIUS = 20, 80  # the Gaussian that smooths the heading, in frames (1 s wide, cut at 4 sigma)

_PARENT_INDEX = np.array(PARENTS)


def joints_to_features(joints: np.ndarray, heading: str = "corrected") -> np.ndarray:
    """Features (T, 263) of joint positions (T+1, 22, 3) in metres at 20 fps, Y up; KIT-ML's (T, 251) of (T+1, 21, 3).

    With heading="corrected" turning or moving the whole motion over the floor changes nothing. float32 in
    gives float32 out, all else float64. ValueError for another shape, fewer than 2 frames, NaN or infinity.
    """
    if heading not in HEADINGS:
        raise ValueError(f"heading must be one of {', '.join(HEADINGS)}, got {heading!r}")
    joints, dtype = _checked_joints(joints, min_frames=2)
    num_frames, body = len(joints) - 1, skeleton_of(joints.shape[1])  # T
    joints = joints / body.unit
    places, rotations, velocities, contacts = body.blocks

    if heading == "corrected":
        yaw = smooth_yaw(facing_yaw(joints))  # (T+1,)
        half_steps = -np.diff(yaw) / 2  # (T,)
        seen = turn(joints, -yaw)  # (T+1, 22, 3) in each frame's heading
        start, posed = np.array([1.0, 0.0, 0.0, 0.0]), seen[:-1]
    else:
        yaw = released_yaw(joints)
        half_steps = np.arcsin(np.sin(-np.diff(yaw) / 2))  # loses the sign where yaw wraps at 180 degrees
        seen = turn(joints, -yaw)
        start, posed = (
            quat_yaw(-yaw[:-1])[:, None],
            joints[:-1],
        )  # world to heading, used as if it were a pose

    steps = np.diff(joints, axis=0)  # (T, 22, 3)
    positions = seen[:-1, 1:].copy()  # (T, 21, 3)
    positions[..., [0, 2]] -= seen[:-1, :1, [0, 2]]

    features = np.empty((num_frames, body.num_features), dtype=dtype)
    features[:, 0] = half_steps
    features[:, ROOT_LINEAR] = turn(steps[:, 0], -yaw[1:])[:, [0, 2]]
    features[:, 3] = joints[:-1, 0, 1]
    features[:, places] = positions.reshape(num_frames, -1)
    features[:, rotations] = _chain_rotations(posed, start, body).reshape(num_frames, -1)
    features[:, velocities] = turn(steps, -yaw[:-1]).reshape(num_frames, -1)
    features[:, contacts] = (steps[:, body.contact_joints] ** 2).sum(-1) < body.contact_threshold
    return features


def features_to_joints(features: np.ndarray) -> np.ndarray:
    """Joint positions (..., T, 22, 3), in metres, of features (..., T, 263): frame 0 at the floor's origin, facing +Z.

    KIT-ML's (..., T, 251) are (..., T, 21, 3). It reads only the first 67 numbers (64), so essential features do as
    well; coordinates (..., T, 66) are joints already. ValueError for another width or for numbers that are not finite.
    """
    features = np.asarray(features)
    widths = [n for body in SKELETONS for n in (body.num_features, body.num_essential, 3 * body.num_joints)]
    if features.ndim < 2 or features.shape[-1] not in widths or features.shape[-2] < 1:
        told = "(..., T, 263), (..., T, 67) or (..., T, 66), of KIT-ML 251, 64 or 63, with T >= 1"
        raise ValueError(f"features must be {told}, got {features.shape}")
    body = skeleton_of(features.shape[-1])
    if features.shape[-1] == 3 * body.num_joints:
        if not np.isfinite(features).all():
            raise ValueError("coordinates hold NaN or infinite numbers; a motion must be finite in every frame")
        return features.reshape(*features.shape[:-1], body.num_joints, 3)
    dtype = np.float32 if features.dtype == np.float32 else np.float64
    essential = features[..., : body.num_essential].astype(np.float64)
    if not np.isfinite(essential).all():
        raise ValueError("features hold NaN or infinite numbers; a motion must be finite in every frame")

    yaw = np.zeros(essential.shape[:-1])  # (..., T)
    yaw[..., 1:] = -2 * np.cumsum(essential[..., :-1, 0], axis=-1)
    steps = np.zeros((*yaw.shape, 3))
    steps[..., 1:, [0, 2]] = essential[..., :-1, ROOT_LINEAR]
    root = np.cumsum(turn(steps, yaw), axis=-2)  # (..., T, 3), still on the floor

    joints = np.zeros((*yaw.shape, body.num_joints, 3))
    joints[..., 0, 1] = essential[..., 3]
    joints[..., 1:, :] = essential[..., 4:].reshape(*yaw.shape, body.num_joints - 1, 3)
    return ((turn(joints, yaw) + root[..., None, :]) * body.unit).astype(dtype)


def features_of(joints: np.ndarray) -> np.ndarray:
    """Features (T, 263) of all T frames of joints (T, 22, 3), the last step taken twice: a step needs a next frame."""
    step = joints[-1:] - joints[-2:-1]  # nothing if there is one frame
    return joints_to_features(np.concatenate([joints, joints[-1:] + (step if len(step) else 0)]))


def essential(features: np.ndarray) -> np.ndarray:
    """The essential features (..., T, 67 or 64): root and positions, all that recovery needs (MARDM); a view."""
    features = np.asarray(features)
    return features[..., : skeleton_of(features.shape[-1]).num_essential]


def coordinates(features: np.ndarray) -> np.ndarray:
    """The absolute joint coordinates (..., T, 66 or 63) that the features stand for, frame 0 facing +Z (CDAMD)."""
    joints = features_to_joints(features)
    return joints.reshape(*joints.shape[:-2], 3 * joints.shape[-2])


def turn(points: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Turn points (..., 3) about +Y by angles with their leading dimensions, for instance (T,)."""
    yaw = np.asarray(yaw).reshape(np.shape(yaw) + (1,) * (points.ndim - 1 - np.ndim(yaw)))
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, z = points[..., 0], points[..., 2]
    return np.stack([cos * x + sin * z, points[..., 1], cos * z - sin * x], axis=-1)


def facing_yaw(joints: np.ndarray) -> np.ndarray:
    """Where hips and shoulders face, per frame and unwrapped (T,), in radians: 0 is +Z, positive is left."""
    left_hip, right_hip, left_shoulder, right_shoulder = skeleton_of(joints.shape[1]).across
    across = (joints[:, right_hip] - joints[:, left_hip]) + (joints[:, right_shoulder] - joints[:, left_shoulder])
    return np.unwrap(np.arctan2(across[:, 2], -across[:, 0]))  # forward is Y x across = (z, 0, -x)


def smooth_yaw(yaw: np.ndarray) -> np.ndarray:
    """Gaussian smoothing of an unwrapped angle (T,), reflected oddly at both ends, where it keeps its value.

    Odd means theta(-s) = 2 theta(0) - theta(s): a steady turn goes on beyond the ends, and what lies on
    either side of an end averages to the end itself, so the first smoothed heading is the first true heading.
    """
    last = len(yaw) - 1
    if last < 1:
        return yaw
    line = np.linspace(yaw[0], yaw[-1], len(yaw))
    # Without the line that joins its ends, the reflected angle repeats every 2 * last frames, negated in the
    # second half. A line is its own average, so only the rest needs smoothing. Works for clips of any length.
    frames = np.arange(-RADIUS, len(yaw) + RADIUS) % (2 * last)
    mirrored = frames > last
    rest = (yaw - line)[np.where(mirrored, 2 * last - frames, frames)] * np.where(mirrored, -1.0, 1.0)
    return line + np.convolve(rest, _GAUSSIAN, mode="valid")


def released_yaw(joints: np.ndarray) -> np.ndarray:
    """The heading (T,) of the released data: hips swapped, vectors smoothed, first row 0."""
    left_hip, right_hip, left_shoulder, right_shoulder = skeleton_of(joints.shape[1]).across
    swapped = (joints[:, left_hip] - joints[:, right_hip]) + (joints[:, right_shoulder] - joints[:, left_shoulder])
    across = normalize(swapped)
    padded = np.pad(across[:, [2, 0]], ((RADIUS, RADIUS), (0, 0)), mode="edge")
    z, x = (np.convolve(column, _GAUSSIAN, mode="valid") for column in padded.T)
    yaw = np.arctan2(z, -x)
    yaw[0] = 0.0
    return yaw


_GAUSSIAN = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
_GAUSSIAN /= _GAUSSIAN.sum()


def _chain_rotations(joints: np.ndarray, start: np.ndarray, body: Skeleton) -> np.ndarray:
    """6D rotations (T, J-1, 6) of every bone relative to the one before; chains start at rotation `start`."""
    # The joint before each on its chain. 0 stands for the chain's start: arms too begin at the root's rotation and not
    # at that of the joint they hang from, a peculiarity of the format that we keep.
    previous = np.zeros(body.num_joints, dtype=int)
    for chain in body.chains:
        previous[list(chain[2:])] = chain[1:-1]
    bones = joints[:, 1:] - joints[:, list(body.parents[1:])]  # (T, J-1, 3)
    world = np.empty((len(joints), body.num_joints, 4))
    world[:, :1] = start
    world[:, 1:] = quat_between(body.raw_directions[1:], bones)
    local = quat_multiply(quat_inverse(world[:, previous[1:]]), world[:, 1:])  # (T, J-1, 4)
    w, x, y, z = np.moveaxis(local, -1, 0)
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]  # columns of the matrix
    second = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    return np.stack(first + second, axis=-1)


def canonicalize(joints: np.ndarray, retarget: bool = False, floor: bool = False) -> np.ndarray:
    """Move and turn joints (T, 22, 3) so that frame 0 stands at x = z = 0 and faces +Z; heights stay.

    retarget=True first gives a body of 22 joints HumanML3D's bone lengths; floor=True moves the whole clip up or down
    until its lowest joint is at y = 0.
    """
    joints, dtype = _checked_joints(joints)
    if retarget:
        joints = _retarget(joints)
    joints = joints - joints[0, 0] * [1.0, 0.0, 1.0]
    if floor:
        joints[..., 1] -= joints[..., 1].min()
    return turn(joints, np.full(len(joints), -facing_yaw(joints[:1])[0])).astype(dtype)


def retarget(joints: np.ndarray, lengths: np.ndarray = BONE_LENGTHS, scale_path: bool = True) -> np.ndarray:
    """Give joints (T, 22, 3) the bone lengths (22,) in metres; directions stay, and the path scales by leg.

    scale_path=False leaves the pelvis where it is: generated bones, which nothing in the 263 features keeps, get their
    length back, frame by frame. ValueError: joints of another body, lengths that are none, a bone without a direction.
    """
    joints, dtype = _checked_joints(joints, bodies=(SMPL22,))
    lengths = np.asarray(lengths, dtype=np.float64)
    if lengths.shape != (NUM_JOINTS,) or not (np.isfinite(lengths).all() and (lengths[1:] > 0).all()):
        raise ValueError(f"lengths must be {NUM_JOINTS} numbers, positive but for the pelvis, got {lengths}")
    bones = joints - joints[:, _PARENT_INDEX]  # (T, 22, 3); the pelvis row means nothing
    source = np.linalg.norm(bones, axis=-1)
    if (source[:, 1:] == 0).any():
        frame, joint = np.argwhere(source[:, 1:] == 0)[0] + [0, 1]
        raise ValueError(f"{JOINT_NAMES[joint]} lies on its parent in frame {frame}: the bone has no direction")
    legs = [5, 8]  # the right thigh and shin of frame 0 say how tall the body is
    result = np.empty_like(joints)
    result[:, 0] = joints[:, 0] * (lengths[legs].sum() / source[0, legs].sum() if scale_path else 1.0)
    for level in LEVELS:
        result[:, level] = result[:, _PARENT_INDEX[level]] + normalize(bones[:, level]) * lengths[level, None]
    return result.astype(dtype)


_retarget = retarget  # canonicalize has a parameter of the same name


def mirror_joints(joints: np.ndarray) -> np.ndarray:
    """The motion (..., 22 or 21, 3) in a mirror: x changes sign, left and right joints change places."""
    joints = np.asarray(joints)
    if joints.shape[-2:] not in [(body.num_joints, 3) for body in SKELETONS]:
        raise ValueError(f"joints must have shape (..., 22, 3) or (..., 21, 3), got {joints.shape}")
    return joints[..., skeleton_of(joints.shape[-2]).mirror, :] * np.array([-1, 1, 1], dtype=joints.dtype)


_MIRRORED_WORDS = {"left": "right", "right": "left", "clockwise": "counterclockwise"}
_SIDED = re.compile(r"\b(left|right|(?:(?:counter|anti)[- ]?)?clockwise)(?=\b|ward|hand|most)", re.IGNORECASE)


def mirror_caption(caption: str) -> str:
    """The caption of the mirrored motion: left and right, clockwise and counterclockwise change places."""

    def swap(match: re.Match) -> str:
        word = match[0]
        swapped = _MIRRORED_WORDS.get(word.lower(), "clockwise")
        return swapped.upper() if word.isupper() else swapped.capitalize() if word[0].isupper() else swapped

    return _SIDED.sub(swap, caption)


def _checked_joints(
    joints: np.ndarray, min_frames: int = 1, bodies: tuple[Skeleton, ...] = SKELETONS
) -> tuple[np.ndarray, type]:
    """Joints as float64 with the dtype to answer in, or a ValueError that says what is wrong with them."""
    joints = np.asarray(joints)
    dtype = np.float32 if joints.dtype == np.float32 else np.float64
    if joints.ndim != 3 or joints.shape[1:] not in [(body.num_joints, 3) for body in bodies]:
        told = " or ".join(f"(frames, {body.num_joints}, 3)" for body in bodies)
        raise ValueError(f"joints must have shape {told} in metres, got {joints.shape}")
    if len(joints) < min_frames:
        raise ValueError(f"joints need at least {min_frames} frames (a step needs a next frame), got {len(joints)}")
    joints = joints.astype(np.float64)
    if not np.isfinite(joints).all():
        frame, joint, _ = np.argwhere(~np.isfinite(joints))[0]
        name = skeleton_of(joints.shape[1]).joint_names[joint]
        raise ValueError(f"joints must be finite, but {name} is {joints[frame, joint]} in frame {frame}")
    return joints, dtype
