"""The body: 22 joints (or KIT-ML's 21), how they hang together, and the rotation algebra that moves them.

Everything is numpy, float64 inside, and vectorised over leading dimensions: a function that takes one
quaternion (4,) also takes a clip of them (T, 22, 4). Space is metres, Y up; a person who faces +Z has the
left hand at +X. A quaternion is (w, x, y, z) and q rotates v as q v q^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FPS = 20  # frames per second of every motion in this library but KIT-ML's

JOINT_NAMES = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle"),
    *("right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
NUM_JOINTS = len(JOINT_NAMES)  # 22, the SMPL order without hands

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)

# Distance from each joint to its parent in HumanML3D's uniform skeleton (m); the pelvis has none.
BONE_LENGTHS = np.array(
    [0.0, 0.103074, 0.109883, 0.131568, 0.393623, 0.390188, 0.143190, 0.432433]
    + [0.425643, 0.057365, 0.143382, 0.149419, 0.219360, 0.137487, 0.143383, 0.103039]
    + [0.131614, 0.122984, 0.256840, 0.263092, 0.266012, 0.269876]
)

# The paths along which HumanML3D chains its rotations. Note that both arms start at spine3 (9).
CHAINS = ((0, 2, 5, 8, 11), (0, 1, 4, 7, 10), (0, 3, 6, 9, 12, 15), (9, 14, 17, 19, 21), (9, 13, 16, 18, 20))

LEFT_RIGHT = ((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21))
LEFT_JOINTS = tuple(left for left, _ in LEFT_RIGHT)
RIGHT_JOINTS = tuple(right for _, right in LEFT_RIGHT)
MIRROR = np.arange(NUM_JOINTS)  # MIRROR[j] is the joint that j becomes in a mirror
for _left, _right in LEFT_RIGHT:
    MIRROR[_left], MIRROR[_right] = _right, _left

# Where each bone points (unit vector, parent to joint) at rest: standing, arms hanging, feet forward.
_X, _Y, _Z = np.eye(3)
RAW_DIRECTIONS = np.array(
    [0 * _X, _X, -_X, _Y, -_Y, -_Y, _Y, -_Y, -_Y, _Y, _Z, _Z, _Y, _X, -_X, _Z] + [-_Y] * 6  # (22, 3)
)
REST_OFFSETS = RAW_DIRECTIONS * BONE_LENGTHS[:, None]  # (22, 3) metres, parent to joint

# Joints grouped by their distance from the pelvis, so that the tree is walked in 7 steps instead of 21.
_DEPTH = [0] * NUM_JOINTS
for _joint in range(1, NUM_JOINTS):
    _DEPTH[_joint] = _DEPTH[PARENTS[_joint]] + 1
LEVELS = tuple(np.flatnonzero(np.array(_DEPTH) == depth) for depth in range(1, max(_DEPTH) + 1))

_PARENT_INDEX = np.array(PARENTS)


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A data set's body: its joints, and in what units and at what rate its features tell of them."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    chains: tuple[tuple[int, ...], ...]  # right leg, left leg, trunk, right arm, left arm
    left_right: tuple[tuple[int, int], ...]
    raw_directions: np.ndarray  # (J, 3) where each bone points at rest
    across: tuple[int, int, int, int]  # left hip, right hip, left shoulder, right shoulder: they say where it faces
    contact_joints: tuple[int, int, int, int]  # left ankle, left foot, right ankle, right foot
    contact_threshold: float  # squared units per frame: what is slower counts as planted
    head: int
    fps: float
    unit: float  # metres in a unit of length of the features
    min_frames: int  # shorter clips are left out of the data set

    @property
    def num_joints(self) -> int:
        """J: 22 or 21."""
        return len(self.joint_names)

    @property
    def num_features(self) -> int:
        """Numbers a frame: 263 or 251."""
        return 12 * self.num_joints - 1

    @property
    def num_essential(self) -> int:
        """Those of them that recovery needs: root and positions, 67 or 64."""
        return 3 * self.num_joints + 1

    @property
    def blocks(self) -> tuple[slice, slice, slice, slice]:
        """The columns of positions, rotations, velocities and contacts; the root's four come before."""
        a, b, c = self.num_essential, 9 * self.num_joints - 5, 12 * self.num_joints - 5
        return slice(4, a), slice(a, b), slice(b, c), slice(c, c + 4)

    @property
    def feet(self) -> tuple[int, int]:
        """The left and the right foot's joint."""
        return self.contact_joints[1], self.contact_joints[3]

    @property
    def sides(self) -> list[str]:
        """ "left", "right" or "middle" for each joint."""
        found = {joint: side for pair in self.left_right for joint, side in zip(pair, ("left", "right"))}
        return [found.get(joint, "middle") for joint in range(self.num_joints)]

    @property
    def mirror(self) -> np.ndarray:
        """Which joint each joint becomes in a mirror. (J,)"""
        found = {a: b for pair in self.left_right for a, b in (pair, pair[::-1])}
        return np.array([found.get(joint, joint) for joint in range(self.num_joints)])


SMPL22 = Skeleton(
    *(JOINT_NAMES, PARENTS, CHAINS, LEFT_RIGHT, RAW_DIRECTIONS, (1, 2, 16, 17), (7, 10, 8, 11)),
    contact_threshold=0.002,  # 0.89 m/s
    head=15,
    fps=FPS,
    unit=1.0,
    min_frames=40,
)

# KIT-ML as Guo et al. (2022) released it. The Master Motor Map, where it comes from, calls joints 5-7 and 11-15 left;
# the features face +Z with them at -X, which is the right, and so does all that reads them. Their rest directions
# kept the sign of the left, which only the rotations (a convention) know of.
_KIT_LIMBS = ("hip", "knee", "ankle", "heel", "foot")
KIT21 = Skeleton(
    joint_names=(
        *("pelvis", "spine1", "spine2", "neck", "head", "right_shoulder", "right_elbow", "right_wrist"),
        *("left_shoulder", "left_elbow", "left_wrist", *(f"right_{limb}" for limb in _KIT_LIMBS)),
        *(f"left_{limb}" for limb in _KIT_LIMBS),
    ),
    parents=(-1, 0, 1, 2, 3, 3, 5, 6, 3, 8, 9, 0, 11, 12, 13, 14, 0, 16, 17, 18, 19),
    chains=((0, 11, 12, 13, 14, 15), (0, 16, 17, 18, 19, 20), (0, 1, 2, 3, 4), (3, 5, 6, 7), (3, 8, 9, 10)),
    left_right=((8, 5), (9, 6), (10, 7), (16, 11), (17, 12), (18, 13), (19, 14), (20, 15)),
    raw_directions=np.array(
        [0 * _X, *[_Y] * 4, _X, -_Y, -_Y, -_X, -_Y, -_Y, _X, -_Y, -_Y, _Z, _Z, -_X, -_Y, -_Y, _Z, _Z]  # (21, 3)
    ),
    across=(16, 11, 8, 5),
    contact_joints=(19, 20, 14, 15),
    contact_threshold=0.05,  # 4 mm/s: hardly ever
    head=4,
    fps=12.5,
    unit=0.75 / 480,  # 1.56 mm: the root, at 560 units, is 0.87 m above the floor
    min_frames=24,
)
SKELETONS = (SMPL22, KIT21)


def skeleton_of(size: int) -> Skeleton:
    """The body with so many joints (22, 21), features (263, 251), essential ones (67, 64) or coordinates (66, 63).

    ValueError: no body's.

    No two of these numbers are the same, so an array's own shape says whose it is.
    """
    for body in SKELETONS:
        if size in (body.num_joints, body.num_features, body.num_essential, 3 * body.num_joints):
            return body
    raise ValueError(
        f"expected 263 features or 22 joints (HumanML3D), or 251 features or 21 joints (KIT-ML), and {size} came"
    )


for _constant in (BONE_LENGTHS, MIRROR, RAW_DIRECTIONS, REST_OFFSETS, _PARENT_INDEX, KIT21.raw_directions):
    _constant.setflags(write=False)  # shared by everyone, so nobody may edit them in place


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cross product (..., 3) over the last axis; np.cross without its overhead."""
    (ux, uy, uz), (vx, vy, vz) = np.moveaxis(np.asarray(u), -1, 0), np.moveaxis(np.asarray(v), -1, 0)
    return np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=-1)


def normalize(v: np.ndarray) -> np.ndarray:
    """Unit vectors along the last axis; a zero vector stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)


def quat_multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton product p q (..., 4): the rotation that does q first, then p."""
    (pw, px, py, pz), (qw, qx, qy, qz) = np.moveaxis(np.asarray(p), -1, 0), np.moveaxis(np.asarray(q), -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def quat_inverse(q: np.ndarray) -> np.ndarray:
    """Inverse of unit quaternions (..., 4)."""
    return np.asarray(q) * np.array([1.0, -1.0, -1.0, -1.0])


def quat_rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate vectors v (..., 3) by unit quaternions q (..., 4); leading dimensions broadcast."""
    q, v = np.asarray(q), np.asarray(v)
    w, axis = q[..., :1], q[..., 1:]
    twice = 2.0 * cross(axis, v)
    return v + w * twice + cross(axis, twice)


def quat_from_axis_angle(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) that turn by `angle` (...) radians about unit `axis` (..., 3), right-handed."""
    axis, half = np.asarray(axis, dtype=float), np.asarray(angle, dtype=float)[..., None] / 2
    axis, half = np.broadcast_arrays(axis, np.broadcast_to(half, np.broadcast_shapes(half.shape, axis.shape)))
    return np.concatenate([np.cos(half[..., :1]), axis * np.sin(half)], axis=-1)


def quat_yaw(angle: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) that turn `angle` (...) radians about +Y: positive turns +Z to +X (left)."""
    half = np.asarray(angle, dtype=float) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, np.sin(half), zero], axis=-1)


def quat_between(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The shortest rotation (..., 4) that takes direction u (..., 3) to direction v (..., 3); its w is >= 0.

    Opposite directions have no single shortest rotation: we take half a turn about an axis square to u.
    """
    u, v = np.broadcast_arrays(normalize(np.asarray(u, dtype=float)), normalize(np.asarray(v, dtype=float)))
    q = np.concatenate([1.0 + (u * v).sum(-1, keepdims=True), cross(u, v)], axis=-1)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    opposite = length[..., 0] < 1e-9
    if opposite.any():
        square = cross(u[opposite], np.where(np.abs(u[opposite][:, :1]) < 0.9, _X, _Y))
        q[opposite] = np.concatenate([np.zeros_like(square[:, :1]), square], axis=-1)
        length = np.linalg.norm(q, axis=-1, keepdims=True)
    return q / length


def quat_to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quat(matrix: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) with w >= 0 of rotation matrices (..., 3, 3)."""
    m = np.asarray(matrix, dtype=float)
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)  # (..., 3)
    trace = diagonal.sum(-1, keepdims=True)
    # q q^T, a 4x4 matrix of rank one, is linear in the matrix; its longest row is the stablest copy of q.
    outer = np.zeros((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace[..., 0]
    for i, (j, k) in enumerate([(1, 2), (2, 0), (0, 1)]):
        outer[..., i + 1, i + 1] = 1 + 2 * diagonal[..., i] - trace[..., 0]
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = m[..., k, j] - m[..., j, k]
        outer[..., j + 1, k + 1] = outer[..., k + 1, j + 1] = m[..., j, k] + m[..., k, j]
    longest = np.diagonal(outer, axis1=-2, axis2=-1).argmax(-1)[..., None, None]
    q = normalize(np.take_along_axis(outer, longest, axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0, -q, q)


def matrix_to_6d(matrix: np.ndarray) -> np.ndarray:
    """The first two columns (..., 6) of rotation matrices (..., 3, 3), 0 then 1 (Zhou et al. 2019)."""
    return np.concatenate([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


def sixd_to_matrix(sixd: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of any six numbers (..., 6), by Gram-Schmidt on the two columns."""
    first = normalize(sixd[..., :3])
    second = sixd[..., 3:] - (first * sixd[..., 3:]).sum(-1, keepdims=True) * first
    second = normalize(second)
    return np.stack([first, second, cross(first, second)], axis=-1)


def forward_kinematics(local_rotations: np.ndarray, root: np.ndarray, offsets: np.ndarray = REST_OFFSETS) -> np.ndarray:
    """Joint positions (..., 22, 3) from joint rotations (..., 22, 4), root (..., 3) and rest bones (22, 3).

    The usual convention (SMPL, BVH): the rotation of joint j is relative to its parent's and turns all that
    hangs below j, so a joint without children may hold anything. `offsets` may also be (..., 22, 3).
    """
    local_rotations = np.asarray(local_rotations, dtype=float)
    if local_rotations.shape[-2:] != (NUM_JOINTS, 4):
        raise ValueError(f"local_rotations must be (..., 22, 4) quaternions, got shape {local_rotations.shape}")
    world = local_rotations.copy()  # (..., 22, 4); row 0 is already in the world
    joints = np.empty((*local_rotations.shape[:-1], 3))
    joints[..., 0, :] = root
    for level in LEVELS:
        parents = _PARENT_INDEX[level]
        bones = quat_rotate(world[..., parents, :], offsets[..., level, :])
        joints[..., level, :] = joints[..., parents, :] + bones
        world[..., level, :] = quat_multiply(world[..., parents, :], local_rotations[..., level, :])
    return joints
