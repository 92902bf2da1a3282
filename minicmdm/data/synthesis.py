"""Program → joints: a body that acts a program out.

The body is driven in three layers. (1) Each segment writes a handful of *channels* over time (how fast the root
moves, how low the pelvis is, how the spine leans, where the arms point); neighbouring segments are cross-faded.
(2) *Steps* are planned along the root's path: a foot is either planted, and then does not move at all, or swings to
where the body will need it. (3) The 22 joints follow: the spine from its angles, the legs by two-bone IK between hip
and planted foot, the arms from their directions. Bones therefore keep their lengths by construction.

Angles are radians, positions metres, time frames at 20 fps, Y up, the first frame faces +Z and left is +X.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from minicmdm.data.moves import BASE, CHANNELS, Style, act, frames_needed
from minicmdm.data.programs import ACTIONS, MAX_FRAMES, MIN_FRAMES, Program, Segment, realise
from minicmdm.data.skeleton import BONE_LENGTHS, FPS

BLEND = 6  # half of a cross-fade, frames
TOE_HEIGHT = 0.02  # the ball of the foot above the floor when planted
# Where each bone points when the body stands straight (x left, y up, z ahead); only directions matter.
_REST = {
    1: (0.55, -0.83, -0.05), 2: (-0.55, -0.83, -0.05), 3: (0, 0.99, -0.1), 6: (0, 1, 0.03), 9: (0, 1, 0.05),
    12: (0, 1, -0.12), 15: (0, 0.93, 0.36), 13: (0.55, 0.83, -0.12), 14: (-0.55, 0.83, -0.12),
    16: (0.95, 0.28, -0.1), 17: (-0.95, 0.28, -0.1), 10: (0.12, -0.42, 0.9), 11: (-0.12, -0.42, 0.9),
}  # fmt: skip
OFFSETS = {j: BONE_LENGTHS[j] * np.array(d) / np.linalg.norm(d) for j, d in _REST.items()}


@dataclass(frozen=True)
class Performance:
    """A program acted out: joints (T+1, 22, 3) and the realised program, whose segments carry start and end."""

    joints: np.ndarray
    program: Program


def smoothstep(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, and a cubic between: (x) any shape."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def synthesise(program: Program, rng: np.random.Generator) -> Performance | None:
    """Act a program out; None when this draw of durations does not fit between 2 and 9.8 seconds.

    The motion has T + 1 frames, T a multiple of 4 (the extra one is for velocities). The same generator state
    gives the same motion.
    """
    style = Style.sample(rng)
    plan = _timeline(program, rng, style)
    if plan is None:
        return None
    parts, total = plan
    channels = _channels(parts, total, rng, style)
    root, yaw = _integrate(channels)
    feet, foot_yaw = _walk(parts, root, yaw, channels, rng, style)
    joints = _pose(channels, root, yaw, feet, foot_yaw, style)
    return Performance(joints, tuple(part for part in parts if part.start is not None and part.count != 0))


# --- when: the timeline -------------------------------------------------------------------------------------------


def _timeline(program: Program, rng: np.random.Generator, style: Style) -> tuple[list[Segment], int] | None:
    """Realised segments with start and end, and the number of frames; a rest (count 0) opens and closes the clip."""
    clock = int(rng.integers(3, 9))
    parts = [Segment("stand", start=0, end=clock, count=0)]
    for segment in program:
        filled = realise(rng, segment)
        after_steps = ACTIONS[parts[-1].action].steps
        length = frames_needed(filled, rng, style) + (10 if after_steps and not ACTIONS[filled.action].steps else 0)
        parts.append(replace(filled, start=clock, end=clock + length))
        clock += length
    tail = int(rng.integers(10, 19)) + (6 if ACTIONS[parts[-1].action].steps else 0)
    total = 4 * int(np.ceil(max(clock + tail, MIN_FRAMES) / 4))
    if total > MAX_FRAMES:
        return None
    parts.append(Segment("stand", start=clock, end=total + 1, count=0))
    return parts, total + 1


def _channels(parts: list[Segment], total: int, rng: np.random.Generator, style: Style) -> dict[str, np.ndarray]:
    """Every channel over the whole clip: segments cross-faded by envelopes that add up to one."""
    out = np.zeros((total, len(CHANNELS)))
    for i, part in enumerate(parts):
        first, last = max(0, part.start - BLEND), min(total, part.end + BLEND)
        t = np.arange(first, last)
        weight = np.ones(len(t))
        if i > 0:
            weight = smoothstep((t - part.start + BLEND) / (2 * BLEND))
        if i < len(parts) - 1:
            weight = weight - smoothstep((t - part.end + BLEND) / (2 * BLEND))
        settle = 10 if i and ACTIONS[parts[i - 1].action].steps and not ACTIONS[part.action].steps else 0
        values = act(part, t, part.start + settle, part.end, rng, style)
        for k, name in enumerate(CHANNELS):
            out[first:last, k] += weight * values.get(name, BASE.get(name, 0.0))
    return {name: out[:, k] for k, name in enumerate(CHANNELS)}


def _integrate(channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Root path (T, 2) as x, z and yaw (T,) from the speed channels; both start at zero."""
    yaw = np.concatenate([[0.0], np.cumsum(channels["turn"][:-1])]) / FPS
    ahead, left = channels["ahead"], channels["left"]
    velocity = np.stack([ahead * np.sin(yaw) + left * np.cos(yaw), ahead * np.cos(yaw) - left * np.sin(yaw)], -1)
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(velocity[:-1], 0)]) / FPS
    return path, yaw  # (T, 2), (T,)


# --- where the feet go ----------------------------------------------------------------------------------------------


def _walk(parts, root, yaw, channels, rng, style) -> tuple[np.ndarray, np.ndarray]:
    """Plan the steps: toes (T, 2, 3) and foot yaw (T, 2), left foot first. Between steps a foot does not move."""
    total = len(root)
    side = np.array([1.0, -1.0])

    def home(foot: int, t: float) -> np.ndarray:
        t = int(np.clip(t, 0, total - 1))
        out, fore = side[foot] * style.stance, 0.10
        c, s = np.cos(yaw[t]), np.sin(yaw[t])
        return np.array([root[t, 0] + out * c + fore * s, root[t, 1] - out * s + fore * c])

    toes = np.zeros((total, 2, 3))
    heading = np.zeros((total, 2))
    free = [0, 0]
    for foot in (0, 1):
        toes[:, foot, [0, 2]] = home(foot, 0)
        heading[:, foot] = yaw[0] + side[foot] * style.toe_out

    def step(foot: int, lift: float, land: float, stance: float, height: float) -> None:
        lift, land = max(int(round(lift)), free[foot], 0), int(round(land))
        land = max(land, lift + 4)
        if lift >= total - 1:
            return
        at = min(land + stance / 2, total - 1)
        target, turned = home(foot, at), yaw[int(at)] + side[foot] * style.toe_out
        start, start_yaw = toes[lift, foot, [0, 2]].copy(), heading[lift, foot]
        t = np.arange(lift, min(land, total - 1) + 1)
        u = (t - lift) / (land - lift)
        go = smoothstep((u - 0.08) / 0.84)[:, None]
        toes[t[:, None], foot, [0, 2]] = start + (target - start) * go
        toes[t[-1] :, foot, [0, 2]] = toes[t[-1], foot, [0, 2]]
        heading[t, foot] = start_yaw + (turned - start_yaw) * go[:, 0]
        heading[t[-1] :, foot] = heading[t[-1], foot]
        toes[t, foot, 1] += height * np.sin(np.pi * u) ** 0.75
        free[foot] = land

    foot = int(rng.integers(2))
    for before, part in zip(parts, parts[1:]):
        if ACTIONS[part.action].steps:
            gait = style.gait(part)
            if abs(free[0] - free[1]) > 1:
                foot = int(np.argmin(free))  # the foot that has stood longer steps next
            elif part.direction is not None:
                foot = 0 if part.direction == "left" else 1
            stride = 2 * FPS / gait.cadence
            swing, stance = (1 - gait.duty) * stride, gait.duty * stride
            clock = max(part.start - (3.0 if before.count is None else 0.0), max(free))
            while clock < part.end + 2:
                step(foot, clock, clock + swing, stance, gait.lift)
                foot = 1 - foot
                clock += stride / 2
        else:
            for f in np.argsort(free):  # bring stray feet home, the one that rested longest first
                begin = max(part.start + 1, *free)
                off = np.linalg.norm(toes[min(begin, total - 1), f, [0, 2]] - home(f, begin + 12))
                if off > 0.05:
                    step(f, begin, begin + 6, 6, 0.07)
    # Bumps written by the channels ride on top: kicks, raised feet, jumps and spread legs.
    c, s = np.cos(yaw), np.sin(yaw)
    for f, name in enumerate("LR"):
        out, up, fore = (channels[f"foot{name}_{axis}"] for axis in ("out", "up", "fore"))
        toes[:, f, 0] += side[f] * out * c + fore * s
        toes[:, f, 2] += -side[f] * out * s + fore * c
        toes[:, f, 1] += up + channels["flight"]
    toes[..., 1] += TOE_HEIGHT
    return toes, heading


# --- the 22 joints --------------------------------------------------------------------------------------------------


def _rotation(yaw, pitch, roll) -> np.ndarray:
    """Ry(yaw) Rx(pitch) Rz(roll) as (T, 3, 3); positive pitch bows forward, positive roll tips to the right."""
    cy, sy, cp, sp, cr, sr = (
        np.cos(yaw),
        np.sin(yaw),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(roll),
        np.sin(roll),
    )
    rows = [
        [cy * cr + sy * sp * sr, -cy * sr + sy * sp * cr, sy * cp],
        [cp * sr, cp * cr, -sp],
        [-sy * cr + cy * sp * sr, sy * sr + cy * sp * cr, cy * cp],
    ]
    return np.moveaxis(np.array(rows), -1, 0)  # (T, 3, 3)


def _arm(side: float, swing: np.ndarray, out: np.ndarray) -> np.ndarray:
    """Direction of a limb in the chest's frame: swing 0 hangs, pi/2 points ahead, pi up; out tips it sideways."""
    return np.stack([side * np.sin(out), -np.cos(out) * np.cos(swing), np.cos(out) * np.sin(swing)], -1)


def _pose(channels, root, yaw, toes, foot_yaw, style) -> np.ndarray:
    """Joints (T, 22, 3) from channels, root path and planted toes."""
    total = len(root)
    joints = np.zeros((total, 22, 3))
    back = channels["back"]
    joints[:, 0, 0] = root[:, 0] - back * np.sin(yaw)
    joints[:, 0, 2] = root[:, 1] - back * np.cos(yaw)
    pelvis = _rotation(yaw + channels["hip_twist"], channels["pelvis_pitch"], channels["hip_roll"])
    hips = np.stack([pelvis @ OFFSETS[1], pelvis @ OFFSETS[2]], 1)  # (T, 2, 3)

    # The ankle stands behind and above the toe; the heel rises as the hip moves ahead of the foot or the foot hangs.
    ahead = (joints[:, None, 0] + hips - toes)[..., [0, 2]]
    forward = np.stack([np.sin(foot_yaw), np.cos(foot_yaw)], -1)
    lead = (ahead * forward).sum(-1)  # (T, 2): how far the hip has passed the toe
    pitch = 0.9 * smoothstep((lead + 0.02) / 0.6) + 0.6 * smoothstep((toes[..., 1] - 0.05) / 0.25)
    pitch = gaussian_filter1d(pitch, 1.0, axis=0, mode="nearest")
    ankles = np.empty_like(toes)
    for f, joint in enumerate((10, 11)):
        ankles[:, f] = toes[:, f] - _rotation(foot_yaw[:, f], pitch[:, f], 0 * yaw) @ OFFSETS[joint]

    # As high as the legs allow: lower the pelvis before a leg would have to stretch.
    reach = 0.985 * np.array([BONE_LENGTHS[4] + BONE_LENGTHS[7], BONE_LENGTHS[5] + BONE_LENGTHS[8]])
    flat = np.linalg.norm((joints[:, None, 0] + hips - ankles)[..., [0, 2]], axis=-1)  # (T, 2)
    top = (ankles[..., 1] + np.sqrt(np.maximum(reach**2 - flat**2, 0.05)) - hips[..., 1]).min(1)
    wanted = style.height + channels["height"] + channels["flight"]
    drop = maximum_filter1d(np.maximum(wanted - top, 0.0), 5, mode="nearest")
    joints[:, 0, 1] = wanted - gaussian_filter1d(drop, 1.0, mode="nearest", truncate=2.0)
    for f, (hip, knee, ankle, toe) in enumerate(((1, 4, 7, 10), (2, 5, 8, 11))):
        joints[:, hip] = joints[:, 0] + hips[:, f]
        pole = np.stack([np.sin(foot_yaw[:, f]), 0 * yaw, np.cos(foot_yaw[:, f])], -1)
        joints[:, knee], joints[:, ankle] = _two_bones(
            joints[:, hip], ankles[:, f], BONE_LENGTHS[knee], BONE_LENGTHS[ankle], pole
        )
        joints[:, toe] = joints[:, ankle] + toes[:, f] - ankles[:, f]

    # Spine: the pelvis' rotation, with lean, tilt and twist shared out over the three vertebrae.
    turned = pelvis
    for joint, parent, share in ((3, 0, 0.3), (6, 3, 0.65), (9, 6, 1.0)):
        joints[:, joint] = joints[:, parent] + turned @ OFFSETS[joint]
        twist = channels["hip_twist"] * (1 - share) + share * channels["twist"]
        turned = _rotation(
            yaw + twist,
            channels["pelvis_pitch"] + share * channels["lean"],
            channels["hip_roll"] * (1 - share) + share * channels["tilt"],
        )
    chest = turned
    joints[:, 12] = joints[:, 9] + chest @ OFFSETS[12]
    skull = _rotation(
        yaw + 0.5 * channels["twist"],
        channels["pelvis_pitch"] + channels["lean"] * 0.7 + channels["nod"],
        0 * yaw,
    )
    joints[:, 15] = joints[:, 12] + skull @ OFFSETS[15]
    for side, collar, shoulder, elbow, wrist, name in (
        (1.0, 13, 16, 18, 20, "L"),
        (-1.0, 14, 17, 19, 21, "R"),
    ):
        joints[:, collar] = joints[:, 9] + chest @ OFFSETS[collar]
        joints[:, shoulder] = joints[:, collar] + chest @ OFFSETS[shoulder]
        # An arm swings forward while its own leg is behind, as in walking.
        swing = channels[f"swing{name}"] * gaussian_filter1d(lead[:, "LR".index(name)], 1.0, mode="nearest")
        upper = _arm(side, channels[f"upper{name}_swing"] + swing, channels[f"upper{name}_out"])
        fore = _arm(side, channels[f"fore{name}_swing"] + swing, channels[f"fore{name}_out"])
        joints[:, elbow] = joints[:, shoulder] + BONE_LENGTHS[elbow] * (chest @ upper[..., None])[..., 0]
        joints[:, wrist] = joints[:, elbow] + BONE_LENGTHS[wrist] * (chest @ fore[..., None])[..., 0]
    return joints


def _two_bones(hip, ankle, thigh: float, shin: float, pole) -> tuple[np.ndarray, np.ndarray]:
    """Knee and ankle (T, 3) of a leg whose knee bends towards `pole`; an ankle out of reach is pulled closer."""
    line = ankle - hip
    wanted = np.linalg.norm(line, axis=-1, keepdims=True)
    line = line / wanted
    length = np.clip(wanted, abs(thigh - shin) + 1e-3, 0.999 * (thigh + shin))
    along = (thigh**2 + length**2 - shin**2) / (2 * length)
    bend = pole - (pole * line).sum(-1, keepdims=True) * line
    bend = bend / np.maximum(np.linalg.norm(bend, axis=-1, keepdims=True), 1e-6)
    knee = hip + along * line + np.sqrt(np.maximum(thigh**2 - along**2, 0.0)) * bend
    return knee, hip + length * line
