"""Our joints as a BVH file of rotations, which other programs read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from minicmdm.data.features import facing_yaw, turn
from minicmdm.data.skeleton import (
    FPS,
    JOINT_NAMES,
    NUM_JOINTS,
    PARENTS,
    RAW_DIRECTIONS,
    normalize,
    quat_between,
    quat_to_matrix,
)
from minicmdm.files import check_output, write_text


def write_bvh(path: str | Path, joints: np.ndarray, fps: float = FPS, force: bool = False) -> Path:
    """Write joints (T,22,3) in metres as a BVH of rotations, in metres.

    Bones get their mean length over the clip: what a motion stretches is not written. Where several bones leave a joint
    (pelvis and chest) they are at rest as in the first frame, and the joint turns as fits them best. Raises as
    `files.check_output` does.
    """
    path = check_output(path, (".bvh",), force)
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (NUM_JOINTS, 3) or not len(joints) or not np.isfinite(joints).all():
        raise ValueError(f"a BVH is made of finite joints (T, {NUM_JOINTS}, 3), and {joints.shape} came")
    lengths = np.linalg.norm(joints - joints[:, list(PARENTS)], axis=-1).mean(0)  # (22,)
    bones = turn(joints[:1] - joints[:1, list(PARENTS)], -facing_yaw(joints[:1]))[0]  # (22,3), as if facing +Z
    branching = np.array([PARENTS.count(parent) > 1 for parent in PARENTS])[:, None]
    offsets = np.where(branching, normalize(bones), RAW_DIRECTIONS) * lengths[:, None]
    degrees = np.degrees(_euler_zxy(_local_rotations(joints, offsets)))  # (T,22,3)
    lines = ["HIERARCHY", *_tree(0, offsets, ""), "MOTION", f"Frames: {len(joints)}", f"Frame Time: {1 / fps:.8f}"]
    for root, turns in zip(joints[:, 0], degrees[:, _written_order()].reshape(len(joints), -1)):
        lines.append(" ".join(f"{value:.6f}" for value in (*root, *turns)))
    write_text(path, "\n".join(lines) + "\n")
    return path


def _local_rotations(joints: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """How each joint turns against its parent, (T,22,3,3), so that its bones at rest point where they do."""
    total = len(joints)
    world, local = np.empty((total, NUM_JOINTS, 3, 3)), np.empty((total, NUM_JOINTS, 3, 3))
    for joint, parent in enumerate(PARENTS):
        children = [child for child in range(NUM_JOINTS) if PARENTS[child] == joint]
        above = world[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (total, 3, 3))
        bones = np.einsum("tji,tcj->tci", above, joints[:, children] - joints[:, [joint]])  # as the parent sees them
        if not children:
            local[:, joint] = np.eye(3)
        elif len(children) == 1:
            local[:, joint] = quat_to_matrix(quat_between(offsets[children[0]], bones[:, 0]))
        else:  # Kabsch: the rotation that brings several directions nearest to theirs
            u, _, vt = np.linalg.svd(np.einsum("tci,cj->tij", bones, offsets[children]))
            u[..., -1] *= np.linalg.det(u @ vt)[:, None]
            local[:, joint] = u @ vt
        world[:, joint] = above @ local[:, joint]
    return local


def _euler_zxy(matrix: np.ndarray) -> np.ndarray:
    """Angles (...,3) about z, then x, then y whose product is the rotation matrix (...,3,3)."""
    x = np.arcsin(np.clip(matrix[..., 2, 1], -1, 1))
    z = np.arctan2(-matrix[..., 0, 1], matrix[..., 1, 1])
    y = np.arctan2(-matrix[..., 2, 0], matrix[..., 2, 2])
    straight = np.abs(matrix[..., 2, 1]) > 1 - 1e-9  # z and y turn about one axis: all of it is z's
    z = np.where(straight, np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0]), z)
    return np.stack([z, x, np.where(straight, 0.0, y)], axis=-1)


def _written_order(joint: int = 0) -> list[int]:
    """The joints as a BVH writes them: each followed by all that hangs on it."""
    return [joint, *(k for child in range(NUM_JOINTS) if PARENTS[child] == joint for k in _written_order(child))]


def _tree(joint: int, offsets: np.ndarray, indent: str) -> list[str]:
    children = [child for child in range(NUM_JOINTS) if PARENTS[child] == joint]
    x, y, z = offsets[joint] if joint else np.zeros(3)
    kind, places = ("JOINT", "") if joint else ("ROOT", "Xposition Yposition Zposition ")
    channels = f"CHANNELS {6 if places else 3} {places}Zrotation Xrotation Yrotation"
    body = [f"OFFSET {x:.6f} {y:.6f} {z:.6f}", channels, *(line for c in children for line in _tree(c, offsets, ""))]
    if not children:
        body += ["End Site", "{", "  OFFSET 0.000000 0.050000 0.000000", "}"]
    lines = [f"{kind} {JOINT_NAMES[joint]}", "{", *("  " + line for line in body), "}"]
    return [indent + line for line in lines]
