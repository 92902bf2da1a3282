"""BVH files, the plain text that motion capture is exchanged in: any hierarchy in, the 22 joints out, and back.

A BVH file holds a tree of joints with offsets, then a line of channels a frame. A joint may have rotations in any order
(degrees, about its own axes, so that the channels are multiplied from left to right) and positions, which then stand in
place of its offset: many exporters give only the root positions, some give them to every joint.

    read_bvh(path)         Bvh: names, parents, offsets, channels, the frames as they are written
    joint_positions(bvh)   (T,J,3) in the file's own unit, by forward kinematics
    to_joints(bvh, map)    (T,22,3) in metres at 20 fps: our joints, our bone lengths, on the floor, facing +Z

`bvh_out.py` goes the other way. Left stays left: nothing is mirrored on the way, as a BVH's axes are right-handed, like
ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minicmdm.data.features import canonicalize
from minicmdm.data.skeleton import FPS, JOINT_NAMES

# Which joint of a file is which of ours: a name, or (a, b, share) for a point on the way from a to b.
Place = str | tuple[str, str, float]
_SIDES = {"left": "L", "right": "R"}
_LIMBS = {"hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot", "foot": "Toes"}
_LIMBS |= {"collar": "Shoulder", "shoulder": "UpperArm", "elbow": "LowerArm", "wrist": "Hand"}
_MIXAMO = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase"}
_MIXAMO |= {"collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
MAPS: dict[str, dict[str, Place]] = {
    "smpl": {name: name for name in JOINT_NAMES},
    "bandai-namco": {
        **{"pelvis": "Hips", "spine1": "Spine", "spine2": "Chest", "spine3": ("Chest", "Neck", 0.25)},
        **{"neck": "Neck", "head": "Head"},
        **{f"{side}_{ours}": f"{theirs}_{end}" for side, end in _SIDES.items() for ours, theirs in _LIMBS.items()},
    },
    "mixamo": {
        **{"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck", "head": "Head"},
        **{f"{s}_{ours}": f"{s.title()}{theirs}" for s in _SIDES for ours, theirs in _MIXAMO.items()},
    },
}


@dataclass(frozen=True)
class Bvh:
    """A BVH file as it is written: lengths in its own unit, angles in degrees."""

    names: list[str]
    parents: list[int]  # -1 for the root; a parent stands before its children
    offsets: np.ndarray  # (J,3)
    channels: list[list[str]]  # per joint, like ["Xposition", "Zrotation"], in the order in which they are written
    frames: np.ndarray  # (T,C)
    frame_time: float  # seconds


def read_bvh(path: str | Path) -> Bvh:
    """Parse a BVH file. FileNotFoundError, or ValueError with the place where it is not what it says."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: a BVH file was expected")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text: byte {error.start} is not UTF-8") from error
    head, found, tail = text.partition("MOTION")
    if not head.lstrip().startswith("HIERARCHY") or not found:
        raise ValueError(f"{path} is no BVH file: HIERARCHY and MOTION were expected")
    names, parents, offsets, channels = _hierarchy(path, head.split()[1:])
    lines = [line.split() for line in tail.splitlines() if line.split()]
    if len(lines) < 2 or lines[0][0] != "Frames:" or [word.lower() for word in lines[1][:2]] != ["frame", "time:"]:
        raise ValueError(f"{path}: after MOTION, 'Frames: T' and 'Frame Time: seconds' were expected")
    count, frame_time = _number(path, lines[0][-1], "the number of frames"), _number(path, lines[1][-1], "Frame Time")
    rows, width = lines[2:], sum(map(len, channels))
    if count != len(rows):
        raise ValueError(f"{path} says that it has {count:g} frames, and {len(rows)} lines of them follow")
    if count < 1 or not 1e-4 <= frame_time <= 10:
        raise ValueError(f"{path}: at least one frame, and from 0.0001 to 10 s for each, not {count:g} of {frame_time}")
    for number, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"{path}: frame {number} has {len(row)} numbers, and the hierarchy has {width} channels")
    try:
        frames = np.array(rows, dtype=np.float64)  # (T,C)
    except ValueError as error:
        raise ValueError(f"{path}: a frame holds something that is no number ({error})") from error
    if not np.isfinite(frames).all():
        raise ValueError(f"{path}: frame {np.argwhere(~np.isfinite(frames))[0, 0]} holds a NaN or an infinity")
    return Bvh(names, parents, np.array(offsets), channels, frames, frame_time)


def _hierarchy(path: Path, words: list[str]):
    """The joints of the words between HIERARCHY and MOTION. End sites have no name of their own and are left out."""
    names: list[str] = []
    parents, offsets, channels = [], [], []
    stack: list[int] = []  # the joints whose braces are open; -1 is an end site
    at = 0

    def take(count: int) -> list[str]:
        nonlocal at
        at += count
        if count < 0 or at > len(words):
            raise ValueError(f"{path}: the hierarchy ends in the middle of a joint")
        return words[at - count : at]

    while at < len(words):
        (word,) = take(1)
        if word in ("ROOT", "JOINT"):
            first = at
            while at < len(words) and words[at] != "{":
                at += 1
            names.append(" ".join(words[first:at]))
            parents.append(stack[-1] if stack else -1)
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            take(1)
            stack.append(len(names) - 1)
        elif word == "End":
            take(2)
            stack.append(-1)
        elif word == "}" and stack:
            stack.pop()
        elif word == "OFFSET" and stack:
            values = [_number(path, value, "OFFSET") for value in take(3)]
            if stack[-1] >= 0:
                offsets[stack[-1]] = values
        elif word == "CHANNELS" and stack and stack[-1] >= 0:
            own = take(int(_number(path, take(1)[0], "CHANNELS")))
            if wrong := [c for c in own if c[:1] not in "XYZ" or c[1:] not in ("position", "rotation")]:
                raise ValueError(f"{path}: joint {names[stack[-1]]} has an unknown channel {wrong[0]!r}")
            channels[stack[-1]] = own
        else:
            raise ValueError(f"{path}: {word!r} was not expected in the hierarchy")
    if stack or not names or parents.count(-1) != 1:
        raise ValueError(f"{path}: one tree of joints in closed braces was expected")
    return names, parents, offsets, channels


def _number(path: Path, word: str, what: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"{path}: {what} is no number: {word!r}") from None
    if not np.isfinite(value):
        raise ValueError(f"{path}: {what} is not finite")
    return value


def joint_positions(bvh: Bvh) -> np.ndarray:
    """Where every joint is (T,J,3), in the file's unit, by forward kinematics over rotations in any order."""
    total, column = len(bvh.frames), 0
    positions, turned = np.empty((total, len(bvh.names), 3)), np.empty((total, len(bvh.names), 3, 3))
    for joint, (parent, channels) in enumerate(zip(bvh.parents, bvh.channels)):
        local = np.broadcast_to(bvh.offsets[joint], (total, 3)).copy()
        rotation = np.broadcast_to(np.eye(3), (total, 3, 3))
        for channel in channels:
            axis, value = "XYZ".index(channel[0]), bvh.frames[:, column]
            if channel.endswith("position"):
                local[:, axis] = value
            else:
                rotation = rotation @ _about(axis, np.radians(value))
            column += 1
        if parent < 0:
            positions[:, joint], turned[:, joint] = local, rotation
        else:
            positions[:, joint] = positions[:, parent] + np.einsum("tij,tj->ti", turned[:, parent], local)
            turned[:, joint] = turned[:, parent] @ rotation
    return positions


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (T,3,3) by `angle` (T,) about x, y or z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((len(angle), 3, 3))
    matrix[:, axis, axis] = 1
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, j, i], matrix[:, i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def to_joints(bvh: Bvh, joint_map: Mapping[str, Place] | None = None, up: str = "y") -> np.ndarray:
    """Our joints (T,22,3): metres, 20 fps, HumanML3D's bone lengths, lowest point on the floor, facing +Z at first.

    The unit does not matter, as the bones get our lengths and the path scales with the legs. `joint_map` is one of
    `MAPS` (found by its names if not given) or one's own; `up` is "y", or "z" for files in which z points up.
    ValueError: names that the file lacks, or a bone without a length.
    """
    joint_map = find_map(bvh.names) if joint_map is None else joint_map
    if up not in ("y", "z"):
        raise ValueError(f"up must be 'y' or 'z', and {up!r} came")
    places = joint_positions(bvh)
    if up == "z":  # a turn about x, which leaves left and right as they are
        places = places[..., [0, 2, 1]] * [1, 1, -1]

    def place(where: Place) -> np.ndarray:
        if isinstance(where, str):
            return places[:, bvh.names.index(where)]
        a, b, share = where
        return (1 - share) * place(a) + share * place(b)

    check_map(joint_map, bvh.names)
    joints = np.stack([place(joint_map[name]) for name in JOINT_NAMES], axis=1)  # (T,22,3)
    return canonicalize(at_our_rate(joints, 1 / bvh.frame_time), retarget=True, floor=True)


def at_our_rate(joints: np.ndarray, fps: float) -> np.ndarray:
    """Joints (T,22,3) at `fps` frames a second -> the same seconds at 20, between neighbours in a straight line."""
    seconds = (len(joints) - 1) / fps
    when = np.arange(int(seconds * FPS + 1e-3) + 1) * fps / FPS  # in frames of the source
    before = np.minimum(when.astype(int), max(len(joints) - 2, 0))
    after = np.minimum(before + 1, len(joints) - 1)
    share = np.clip(when - before, 0, 1)[:, None, None]
    return (1 - share) * joints[before] + share * joints[after]


def find_map(names: Sequence[str]) -> dict[str, Place]:
    """The map of `MAPS` whose joints are all there, prefixes like "mixamorig:" set aside. ValueError: none is."""
    short = {name.rpartition(":")[2]: name for name in names}
    for joint_map in MAPS.values():
        try:
            check_map(joint_map, list(short))
        except ValueError:
            continue
        return {
            ours: short[where] if isinstance(where, str) else (short[where[0]], short[where[1]], where[2])
            for ours, where in joint_map.items()
        }
    raise ValueError(f"none of the joint maps {', '.join(MAPS)} fits these joints: {', '.join(names)}")


def check_map(joint_map: Mapping[str, Place], names: Sequence[str]) -> None:
    """ValueError unless the map says where each of our 22 joints is among `names`."""
    if missing := [name for name in JOINT_NAMES if name not in joint_map]:
        raise ValueError(f"the joint map says nothing of {', '.join(missing)}")
    asked = [part for where in joint_map.values() for part in ([where] if isinstance(where, str) else where[:2])]
    if missing := [name for name in asked if name not in names]:
        raise ValueError(f"the joint map asks for {missing[0]!r}, and the file has {', '.join(names)}")
