"""How each action moves: the channels a segment writes, and how long it needs.

A channel is one number per frame: root speeds (m/s, rad/s), pelvis height and shift (m), trunk angles, arm directions
(radians, see `synthesis._arm`) and offsets of the feet (m) on top of their steps. `BASE` is standing at ease; an
action names only what differs. Bands of speed do not touch, so that "slowly" can be read back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minicmdm.data.programs import Segment
from minicmdm.data.skeleton import FPS

ARMS = [f"{bone}{side}_{angle}" for side in "LR" for bone in ("upper", "fore") for angle in ("swing", "out")]
FEET = [f"foot{side}_{axis}" for side in "LR" for axis in ("out", "up", "fore")]
TRUNK = ["height", "back", "flight", "pelvis_pitch", "hip_twist", "hip_roll", "lean", "tilt", "twist", "nod"]
CHANNELS = ["ahead", "left", "turn", *TRUNK, *ARMS, *FEET, "swingL", "swingR"]
BASE = {"lean": 0.04, "nod": 0.05}
PAD = 5  # quiet frames before and after the repetitions of a counted action

SPEED_BANDS = {  # m/s along the way of going, slow / normal / fast
    "walk": ((0.50, 0.66), (0.95, 1.15), (1.50, 1.75)),
    "run": ((2.3, 2.9),) * 3,
    "walk_backward": ((0.33, 0.43), (0.66, 0.80), (1.08, 1.25)),
    "sidestep": ((0.26, 0.34), (0.55, 0.66), (0.92, 1.08)),
    "circle": ((0.50, 0.66), (0.95, 1.15), (1.45, 1.65)),
    "crouch_walk": ((0.30, 0.40), (0.62, 0.76), (1.05, 1.22)),
}
RATE_BANDS = {  # Hz: steps of a march, swings of a wave, claps; repetitions of squats and bows
    "march": ((1.15, 1.3), (1.8, 2.1), (2.9, 3.3)),
    "wave": ((0.75, 0.9), (1.45, 1.7), (2.6, 3.0)),
    "clap": ((0.95, 1.1), (1.75, 2.0), (2.9, 3.3)),
    "squat": ((0.36, 0.42), (0.62, 0.72), (1.05, 1.2)),
    "bow": ((0.34, 0.40), (0.58, 0.68), (1.0, 1.12)),
}
# Steps per second = a + b · speed, and frames of one repetition.
CADENCES = {"walk": (1.3, 0.72), "circle": (1.4, 0.72), "run": (2.0, 0.32), "walk_backward": (1.3, 0.9)}
PERIODS = {"jump": (19, 23), "hop": (12, 15), "kick": (17, 21), "punch": (12, 15), "jumping_jack": (20, 24)}


@dataclass(frozen=True)
class Gait:
    """Steps per second, the share of a stride a foot stands, and how high it is lifted (m)."""

    cadence: float
    duty: float
    lift: float


@dataclass(frozen=True)
class Style:
    """What makes two performers differ: drawn once a clip, constant through it."""

    pace: float  # where in a band of speed, 0 to 1
    rhythm: float  # cadence factor
    lift: float  # m, extra height of a step
    stance: float  # m, half the distance between the feet
    toe_out: float  # rad
    height: float  # m, pelvis when standing
    swing: float  # arm swing, rad per metre of stride
    arms_out: float  # rad
    elbow: float  # rad, how bent the hanging arm is
    lean: float
    reach: float  # how far big gestures go, 0 to 1

    @staticmethod
    def sample(rng: np.random.Generator) -> Style:
        """A random performer."""
        low = np.array([0, 0.95, 0.0, 0.085, 0.05, 0.925, 0.7, 0.08, 0.15, -0.02, 0.0])
        high = np.array([1, 1.05, 0.04, 0.12, 0.25, 0.95, 1.6, 0.2, 0.5, 0.08, 1.0])
        return Style(*(low + (high - low) * rng.random(len(low))))

    def within(self, band: tuple[float, float]) -> float:
        """The point of a band that this performer prefers."""
        return band[0] + (band[1] - band[0]) * self.pace

    def speed(self, part: Segment) -> float:
        """Speed (m/s) or rate (Hz) of a segment."""
        bands = SPEED_BANDS.get(part.action) or RATE_BANDS[part.action]
        return self.within(bands[("slow", "normal", "fast").index(part.speed or "normal")])

    def gait(self, part: Segment) -> Gait:
        """How the feet step in a segment whose action walks."""
        if part.action == "march":
            return Gait(self.speed(part), 0.5, 0.24 + self.lift)
        if part.action in ("turn", "spin"):
            return Gait(2.6 * self.rhythm, 0.6, 0.06 + self.lift / 2)
        v = self.speed(part)
        base, per_speed = CADENCES.get(part.action, (1.4, 1.15))
        cadence = (base + per_speed * v) * self.rhythm
        if part.action == "run":
            return Gait(cadence, 0.38, 0.16 + self.lift)
        return Gait(cadence, 0.6, 0.08 + self.lift)


def frames_needed(part: Segment, rng: np.random.Generator, style: Style) -> int:
    """How many frames a realised segment takes."""
    action = part.action
    if action in PERIODS:
        return 2 * PAD + int(part.count * rng.uniform(*PERIODS[action]))
    if action in ("squat", "bow"):
        return 2 * PAD + int(part.count * FPS / style.speed(part))
    if action == "turn":
        return int(rng.integers(26, 33))
    if action == "spin":
        return int(rng.integers(48, 61))
    low, high = {"short": (30, 36), "normal": (42, 54), "long": (66, 80)}[part.duration]
    if action == "stand":
        low, high = {"short": (46, 50), "normal": (54, 62), "long": (76, 86)}[part.duration]
    length = int(rng.integers(low, high + 1))
    if action in ("march", "wave", "clap") and part.speed == "slow":
        length = max(length, 54)
    return max(length, 40) if action in ("sit", "circle", "raise_arms") else length


# --- shapes in time, all from 0 to 1 ------------------------------------------------------------------------------


def _ramp(x):
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def _hold(t, start, end, rise):
    """Up within `rise` frames after start, down within `rise` frames before end."""
    return _ramp((t - start) / rise) * _ramp((end - t) / rise)


def _repeat(t, part: Segment, start, end):
    """Phase 0..1 within each repetition and a mask of the frames that belong to one."""
    q = (t - start - PAD) / ((end - start - 2 * PAD) / part.count)
    inside = (q >= 0) & (q < part.count)
    return np.where(inside, q % 1.0, 0.0), inside


def _leap(r, lift_off, landing, seconds, dip):
    """(flight, height) of one jump over the phase r: crouch, fly on a parabola of gravity's own height, absorb."""
    air = (landing - lift_off) * seconds
    u = np.clip((r - lift_off) / (landing - lift_off), 0, 1)
    flight = 9.81 / 8 * air**2 * 4 * u * (1 - u)
    x, y = np.clip(r / lift_off, 0, 1), np.clip((r - landing) / (1 - landing), 0, 1)
    crouch = np.sin(np.pi * x) * _ramp(2 * x) + 0.8 * np.sin(np.pi * y) * _ramp(2 * (1 - y))
    return flight, -dip * crouch


# --- arms ---------------------------------------------------------------------------------------------------------


def _hang(c: dict, side: str, style: Style, swing: float = 0.0):
    c[f"upper{side}_swing"], c[f"upper{side}_out"] = 0.02, style.arms_out
    c[f"fore{side}_swing"], c[f"fore{side}_out"] = 0.1 + style.elbow, style.arms_out - 0.05
    c[f"swing{side}"] = swing


def _set_arm(c: dict, side: str, upper: tuple, fore: tuple):
    c[f"upper{side}_swing"], c[f"upper{side}_out"] = upper
    c[f"fore{side}_swing"], c[f"fore{side}_out"] = fore
    c[f"swing{side}"] = 0.0


def _gesture(c: dict, gesture: str, t, start, rate: float, style: Style):
    """Arms of a wave, a clap or a raise, whether the action itself or an overlay on another."""
    beat = np.sin(2 * np.pi * rate * (t - start) / FPS)
    if gesture.startswith("wave"):
        side = "L" if gesture == "wave_left" else "R"
        _set_arm(c, side, (0.35, 1.15 + 0.25 * style.reach), (np.pi - 0.15, 0.1 + 0.5 * beat))
    elif gesture == "clap":
        for side in "LR":
            _set_arm(c, side, (0.65 + 0.25 * style.reach, 0.05), (1.5 + 0.15 * style.reach, -0.3 + 0.4 * beat))
    else:
        for side in "LR":
            _set_arm(c, side, (np.pi - 0.35 + 0.2 * style.reach, 0.25), (np.pi - 0.1, 0.1))


# --- the actions --------------------------------------------------------------------------------------------------


def act(part: Segment, t: np.ndarray, start: int, end: int, rng: np.random.Generator, style: Style) -> dict:
    """Channels of one realised segment at the frames t (it runs from start to end): name → (len(t),) or a number."""
    c: dict = {
        "lean": BASE["lean"] + style.lean,
        "hip_roll": 0.01 * np.sin(2 * np.pi * t / 60 + 6 * style.pace),
    }
    going = part.action in SPEED_BANDS
    for side in "LR":
        _hang(c, side, style, style.swing if going else 0.0)
    side = {"left": "L", "right": "R"}.get(part.side)
    sign = {"left": 1.0, "right": -1.0}.get(part.direction or part.side, 0.0)
    action = part.action

    if going:
        v = style.speed(part) * (1 + 0.04 * np.sin(2 * np.pi * (t - start) / 37))
        if action == "sidestep":
            c["left"] = sign * v
        else:
            c["ahead"] = -v if action == "walk_backward" else v
        if action == "circle":
            c["turn"] = sign * v / (0.85 + 0.25 * style.reach)
            c["tilt"] = -0.05 * sign
        if action == "run":
            c["lean"], c["height"] = 0.2 + style.lean, -0.05
            for arm in "LR":
                _set_arm(c, arm, (-0.1, style.arms_out), (1.2, 0.0))
                c[f"swing{arm}"] = 1.0 + 0.4 * style.reach
        if action == "crouch_walk":
            c["height"], c["lean"], c["back"] = -0.27 - 0.05 * style.reach, 0.55, 0.06
    elif action in ("turn", "spin"):
        total = (2 * np.pi if action == "spin" else np.pi / 2) * (0.92 + 0.16 * style.reach)
        profile = _hold(np.arange(start + 2, end - 1), start + 2, end - 2, 6)
        shape = _hold(t, start + 2, end - 2, 6) / profile.sum()
        c["turn"] = sign * total * shape * FPS
        c["nod"] = 0.1
    elif action == "jump":
        r, on = _repeat(t, part, start, end)
        seconds = (end - start - 2 * PAD) / part.count / FPS
        flight, height = _leap(r, 0.3, 0.72, seconds, 0.15 + 0.05 * style.reach)
        c["flight"], c["height"] = flight * on, height * on
        for arm in "LR":
            fling = on * np.sin(np.pi * r) ** 2
            back = on * np.sin(2 * np.pi * r)
            _set_arm(c, arm, (0.1 + 1.2 * fling - 0.5 * back, 0.15), (0.4 + 1.3 * fling, 0.1))
    elif action == "hop":
        r, on = _repeat(t, part, start, end)
        seconds = (end - start - 2 * PAD) / part.count / FPS
        flight, height = _leap(r, 0.28, 0.75, seconds, 0.07)
        up = _hold(t, start - 2, end - 1, 7)
        free = "R" if side == "L" else "L"
        c["flight"], c["height"] = flight * on, height * on - 0.02 * up
        c[f"foot{free}_up"], c[f"foot{free}_fore"] = (0.24 + 0.08 * style.reach) * up, -0.16 * up
        c["hip_roll"] = -0.08 * up * sign
        for arm in "LR":
            _set_arm(c, arm, (0.1, 0.3), (0.9, 0.1))
    elif action in ("squat", "bow"):
        r, on = _repeat(t, part, start, end)
        deep = on * np.sin(np.pi * r) ** 2
        if action == "squat":
            c["height"], c["back"], c["lean"] = (
                -(0.34 + 0.08 * style.reach) * deep,
                0.12 * deep,
                0.05 + 0.4 * deep,
            )
            for arm in "LR":
                _set_arm(c, arm, (0.05 + 1.3 * deep, 0.12), (0.2 + 1.25 * deep, 0.0))
        else:
            c["pelvis_pitch"], c["lean"] = 0.55 * deep, 0.05 + (0.55 + 0.25 * style.reach) * deep
            c["back"] = 0.14 * deep
            for arm in "LR":
                _set_arm(c, arm, (0.02 + 0.5 * deep, style.arms_out), (0.1 + style.elbow + 0.4 * deep, 0.05))
    elif action == "kick":
        r, on = _repeat(t, part, start, end)
        out = on * np.sin(np.pi * r) ** 2
        c[f"foot{side}_fore"], c[f"foot{side}_up"] = (
            (0.5 + 0.1 * style.reach) * out,
            (0.46 + 0.14 * style.reach) * out,
        )
        c["pelvis_pitch"], c["back"] = -0.15 * out, 0.03 * out
        for arm in "LR":
            _set_arm(c, arm, (0.1 + (0.5 if arm != side else -0.3) * out, 0.25), (0.7, 0.1))
    elif action == "punch":
        r, on = _repeat(t, part, start, end)
        out = on * np.sin(np.pi * r) ** 2
        for arm in "LR":
            _set_arm(c, arm, (0.35, 0.15), (2.1, -0.1))
        _set_arm(c, side, (0.35 + 1.2 * out, 0.15 - 0.15 * out), (2.1 - 0.5 * out, -0.1))
        c["twist"] = -sign * 0.35 * out
        c["height"] = -0.03
    elif action == "jumping_jack":
        r, on = _repeat(t, part, start, end)
        seconds = (end - start - 2 * PAD) / part.count / FPS
        apart = on * (_ramp((r - 0.1) / 0.3) - _ramp((r - 0.6) / 0.3))
        hop = np.where(r < 0.5, r - 0.06, r - 0.56) / 0.38
        c["flight"] = on * 9.81 / 8 * (0.38 * seconds) ** 2 * 4 * np.clip(hop, 0, 1) * (1 - np.clip(hop, 0, 1))
        for arm in "LR":
            c[f"foot{arm}_out"] = (0.16 + 0.05 * style.reach) * apart
            _set_arm(c, arm, (0.05, style.arms_out + 2.5 * apart), (0.1, style.arms_out + 2.75 * apart))
        c["height"] = -0.03 * on * np.sin(np.pi * r) ** 2
    elif action == "sit":
        down = _hold(t, start - 4, end + 4, 14)
        c["height"], c["back"] = -(0.42 + 0.04 * style.reach) * down, (0.32 + 0.04 * style.reach) * down
        c["lean"], c["pelvis_pitch"] = 0.05 + 0.12 * down, -0.05 * down
        for arm in "LR":
            _set_arm(c, arm, (0.1 + 0.4 * down, 0.12), (0.2 + 1.1 * down, 0.0))
    elif action == "march":
        for arm in "LR":
            c[f"upper{arm}_swing"] = 0.1
    elif action in ("wave", "clap", "raise_arms"):
        gesture = f"wave_{part.side}" if action == "wave" else action
        _gesture(c, gesture, t, start, style.speed(part) if action != "raise_arms" else 0.0, style)
    if part.overlay is not None:
        rate = {"wave_left": 1.5, "wave_right": 1.5, "clap": 1.9, "raise_arms": 0.0}[part.overlay]
        _gesture(c, part.overlay, t, start, rate * (0.9 + 0.2 * style.pace), style)
    return c
