"""The oracle: joints → what was done. It sees geometry alone: no sentence, no number of segments, no seed.

It measures a few bodily facts in every frame (speed in the body's own frame, pelvis height, feet off the floor, where
the hands are), finds the episodes in which each action shows, lays them on one time line and reads the fields from
the episode. It is the measuring stick of the toy world: what it reads from a synthesised motion is what the program
said (DESIGN.md invariant 7), and what it cannot read it does not guess: a body that does nothing nameable "stands".
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from minicmdm.data.body import Body, bridge, covered, overlay, rate, runs
from minicmdm.data.programs import ACTIONS, Segment
from minicmdm.data.skeleton import FPS

# Midpoints between the bands of moves.py: below the first is slow, above the second fast.
SPEED_LIMITS = {
    "walk": (0.80, 1.32), "circle": (0.80, 1.30), "walk_backward": (0.54, 0.94), "sidestep": (0.44, 0.79),
    "crouch_walk": (0.51, 0.90), "march": (1.55, 2.5), "wave": (1.17, 2.15), "clap": (1.42, 2.45),
    "squat": (0.52, 0.88), "bow": (0.49, 0.84),
}  # fmt: skip
MOVING, RUNNING, CIRCLING, TURNING = 0.17, 1.95, 0.26, 0.35  # m/s, m/s, rad/s, rad/s
CROUCHED, LOW, BENT = 0.755, 0.72, 0.62  # m, m, rad
AIRBORNE = 0.052  # m, height of the lower toe


def read_motion(joints: np.ndarray) -> list[Segment]:
    """Read a motion: joints (T, 22, 3) in metres at 20 fps, Y up, any yaw → segments in order, every field filled.

    Raises ValueError on another shape, fewer than 4 frames or numbers that are not finite.
    """
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] != (22, 3) or len(joints) < 4:
        raise ValueError(f"expected joints of shape (T, 22, 3) with T >= 4, got {joints.shape}")
    if not np.isfinite(joints).all():
        raise ValueError(f"joints hold {int((~np.isfinite(joints)).sum())} numbers that are not finite")
    body = Body(joints)
    episodes = _leaps(body)
    free = ~covered(episodes, body.frames)
    episodes += _travel(body, free)
    free = ~covered(episodes, body.frames)
    episodes += _turns(body, free) + _lows(body, free) + _bows(body, free) + _kicks(body, free)
    free = ~covered(episodes, body.frames)
    episodes += _march(body, free)
    free = ~covered(episodes, body.frames)
    episodes += _hands(body, free)
    return _line_up(sorted(episodes, key=lambda s: s.start), body.frames)


def _speed_word(action: str, value: float) -> str:
    low, high = SPEED_LIMITS[action]
    return "slow" if value < low else "fast" if value > high else "normal"


# --- episodes, one kind a function ------------------------------------------------------------------------------------


def _leaps(body: Body) -> list[Segment]:
    """Both feet off the floor and not running: jumps, hops and jumping jacks, told apart by feet and arms."""
    out: list[Segment] = []
    flights = []
    for a, b in runs(body.toes.min(1) > AIRBORNE):
        rise = body.height[a:b].max() - min(body.height[max(a - 2, 0)], body.height[min(b + 1, body.frames - 1)])
        if b - a >= 3 and rise > 0.06 and body.speed[a:b].mean() < 0.9:
            flights.append((a, b))
    kinds = []
    for a, b in flights:
        apart = body.toes[a:b, 0] - body.toes[a:b, 1]
        wide = slice(max(a - 9, 0), b + 9)
        if body.hands_apart[wide].max() > 1.0:
            kinds.append(("jumping_jack", None))
        elif np.abs(apart).mean() > 0.11:
            kinds.append(("hop", "left" if apart.mean() < 0 else "right"))
        else:
            kinds.append(("jump", None))
    groups: list[list[int]] = []
    for i, kind in enumerate(kinds):
        if groups and kinds[groups[-1][-1]] == kind and flights[i][0] - flights[groups[-1][-1]][1] < 19:
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in groups:
        action, side = kinds[group[0]]
        count = (len(group) + 1) // 2 if action == "jumping_jack" else len(group)
        start, end = max(flights[group[0]][0] - 6, 0), min(flights[group[-1]][1] + 6, body.frames)
        out.append(Segment(action, side=side, count=count, start=start, end=end))
    return out


# Ways of going; the index is a frame's label, 0 means staying.
_WAYS = [(None, None), ("walk", None), ("run", None), ("walk_backward", None), ("sidestep", "left"),
         ("sidestep", "right"), ("circle", "left"), ("circle", "right"), ("crouch_walk", None)]  # fmt: skip


def _way_of_each_frame(body: Body, free: np.ndarray) -> np.ndarray:
    """Label every frame with how the root moves: (T,) of indices into `_WAYS`."""
    label = np.zeros(body.frames, int)
    moving = (body.speed > MOVING) & free
    sideways = np.abs(body.left) > 1.2 * np.abs(body.ahead)
    turn = gaussian_filter1d(body.turn, 3.0, mode="nearest")
    label[moving] = 1
    label[moving & (turn > CIRCLING)] = 6
    label[moving & (turn < -CIRCLING)] = 7
    label[moving & (gaussian_filter1d(body.height, 3.0, mode="nearest") < CROUCHED)] = 8
    label[moving & (body.ahead > RUNNING)] = 2
    label[moving & (body.ahead < 0) & ~sideways] = 3
    label[moving & sideways & (body.left > 0)] = 4
    label[moving & sideways & (body.left < 0)] = 5
    # The commonest label of the half second around wins.
    votes = np.stack([gaussian_filter1d((label == k).astype(float), 4.0, mode="nearest") for k in range(len(_WAYS))])
    label = np.where(moving, votes[1:].argmax(0) + 1, 0)
    for a, b in runs(bridge(moving, 6)):  # gathering speed is not another action: short stretches join a long neighbour
        parts = [(a + x, a + y, k) for k in range(1, len(_WAYS)) for x, y in runs(label[a:b] == k)]
        for x, y, _ in parts:
            beside = [p for p in parts if p[1] - p[0] >= 20 and (abs(p[0] - y) <= 3 or abs(p[1] - x) <= 3)]
            if y - x < 20 and beside:
                label[x:y] = max(beside, key=lambda p: p[1] - p[0])[2]
    return label


def _travel(body: Body, free: np.ndarray) -> list[Segment]:
    """The root goes somewhere: forward, backward, sideways, round, low or fast."""
    label = _way_of_each_frame(body, free)
    out: list[Segment] = []
    for k, (action, direction) in list(enumerate(_WAYS))[1:]:
        for a, b in runs(bridge(label == k, 8)):
            core = body.speed[a + min(6, (b - a) // 4) : b - min(6, (b - a) // 4)]
            # A trunk that shifts over feet that stay (sitting down, bowing) goes nowhere.
            stays = action != "circle" and np.linalg.norm(body.feet[b - 1] - body.feet[a]) < 0.22
            if b - a < 15 or core.max() < 0.23 or stays:
                continue
            speed = _speed_word(action, np.median(core)) if ACTIONS[action].speed else None
            arms = overlay(body, a, b) if ACTIONS[action].overlay else None
            out.append(Segment(action, direction=direction, speed=speed, overlay=arms, start=a, end=b))
    return out


def _turns(body: Body, free: np.ndarray) -> list[Segment]:
    """The body turns on the spot: by about a quarter (turn) or all the way round (spin)."""
    out = []
    for sign, direction in ((1, "left"), (-1, "right")):
        for a, b in runs(bridge((sign * body.turn > TURNING) & free & (body.speed < 0.45), 4)):
            angle = abs(body.yaw[b - 1] - body.yaw[a])
            if b - a >= 8 and angle > np.radians(40):
                out.append(Segment("spin" if angle > np.radians(215) else "turn", direction=direction, start=a, end=b))
    return out


def _lows(body: Body, free: np.ndarray) -> list[Segment]:
    """The pelvis is low and stays in place: held is a sit, dipped is a squat (each dip counts)."""
    out, dips = [], []
    for a, b in runs((body.height < LOW) & (body.feet_speed < 0.4) & free):
        lowest = body.height[a:b].min()
        if b - a < 4 or lowest > 0.65:
            continue
        if (body.height[a:b] < lowest + 0.04).sum() > 19:
            out.append(Segment("sit", overlay=overlay(body, a, b), start=max(a - 4, 0), end=min(b + 4, body.frames)))
        else:
            dips.append((a, b, lowest))
    stand = np.percentile(body.height, 90)
    return out + _counted("squat", dips, body, lambda a, b, low: body.height < (low + stand) / 2)


def _bows(body: Body, free: np.ndarray) -> list[Segment]:
    """The trunk bends far forward over straight legs."""
    dips = [
        (a, b, body.bend[a:b].max()) for a, b in runs((body.bend > BENT) & free & (body.height > LOW)) if b - a >= 3
    ]
    return _counted("bow", dips, body, lambda a, b, most: body.bend > most / 2)


def _counted(action: str, dips: list[tuple[int, int, float]], body: Body, half) -> list[Segment]:
    """Group neighbouring repetitions; the width at half depth of each, half a period, tells the speed."""
    groups: list[list[tuple[int, int, float]]] = []
    for dip in dips:
        if (
            groups
            and dip[0] - groups[-1][-1][1] < 1.3 * max(dip[1] - dip[0], groups[-1][-1][1] - groups[-1][-1][0]) + 12
        ):
            groups[-1].append(dip)
        else:
            groups.append([dip])
    out = []
    for group in groups:
        widths = []
        for a, b, depth in group:
            middle = (a + b) // 2
            widths += [hi - lo for lo, hi in runs(half(a, b, depth)) if lo <= middle < hi]
        often = FPS / (2 * np.mean(widths)) if widths else FPS / 30
        reach = int(np.mean(widths) / 2) if widths else 4
        start, end = max(group[0][0] - reach, 0), min(group[-1][1] + reach, body.frames)
        out.append(Segment(action, speed=_speed_word(action, often), count=len(group), start=start, end=end))
    return out


def _peaks(mask: np.ndarray, gap: int, least: int = 2) -> list[list[tuple[int, int]]]:
    """Short stretches of True, grouped when less than `gap` frames lie between them."""
    groups: list[list[tuple[int, int]]] = []
    for a, b in runs(mask):
        if b - a < least:
            continue
        if groups and a - groups[-1][-1][1] < gap:
            groups[-1].append((a, b))
        else:
            groups.append([(a, b)])
    return groups


def _repeated(action: str, side: str, group: list[tuple[int, int]], pad: int, body: Body) -> Segment:
    """A segment around a group of peaks, one peak a count."""
    start, end = max(group[0][0] - pad, 0), min(group[-1][1] + pad, body.frames)
    return Segment(action, side=side, count=len(group), start=start, end=end)


def _kicks(body: Body, free: np.ndarray) -> list[Segment]:
    """A foot goes high and far ahead while the other stands."""
    out = []
    for f, side in enumerate(("left", "right")):
        high = (body.toes[:, f] > 0.27) & (body.toe_ahead[:, f] > 0.34)
        rooted = (body.toes[:, 1 - f] < 0.12) & (body.speed < 0.6)
        out += [_repeated("kick", side, group, 5, body) for group in _peaks(free & high & rooted, 19)]
    return out


def _march(body: Body, free: np.ndarray) -> list[Segment]:
    """The feet rise in turn and the body stays where it is."""
    lifted = [[(a + b) / 2 for a, b in runs((body.toes[:, f] > 0.14) & free) if 3 <= b - a] for f in (0, 1)]
    steps = sorted([(t, 0) for t in lifted[0]] + [(t, 1) for t in lifted[1]])
    out, group = [], []
    for step in [*steps, (np.inf, 0)]:
        if group and (step[0] - group[-1][0] > 26 or step[1] == group[-1][1]):
            if len(group) >= 3:
                cadence = FPS * (len(group) - 1) / (group[-1][0] - group[0][0])
                half = int(FPS / cadence / 2)
                a, b = max(int(group[0][0]) - half, 0), min(int(group[-1][0]) + half + 1, body.frames)
                speed = _speed_word("march", cadence)
                out.append(Segment("march", speed=speed, overlay=overlay(body, a, b), start=a, end=b))
            group = []
        group.append(step)
    return out


def _hands(body: Body, free: np.ndarray) -> list[Segment]:
    """The legs rest and the arms act: wave, clap, raise, punch."""
    out = []
    for f, side in enumerate(("left", "right")):
        for a, b in runs(bridge(body.waving[:, f] & free, 5)):
            if b - a >= 16:
                speed = _speed_word("wave", rate(body.fore_out[a + 2 : b - 2, f]))
                out.append(Segment("wave", side=side, speed=speed, start=a, end=b))
        reach, guard = body.hand_ahead[:, f], body.hand_ahead[:, 1 - f]
        level = (np.abs(body.hand_up[:, f]) < 0.2) & (np.abs(body.hand_up[:, 1 - f] + 0.12) < 0.14)
        jab = free & level & (reach > 0.40) & (reach - guard > 0.10) & (guard > 0.1)
        out += [_repeated("punch", side, group, 4, body) for group in _peaks(jab, 14)]
    for a, b in runs(bridge(body.raised & free, 5)):
        if b - a >= 16:
            out.append(Segment("raise_arms", start=a, end=b))
    for a, b in runs(bridge(body.clapping & free, 6)):
        if b - a >= 14:
            out.append(Segment("clap", speed=_speed_word("clap", rate(body.hands_apart[a:b])), start=a, end=b))
    return out


def _line_up(episodes: list[Segment], frames: int) -> list[Segment]:
    """Put episodes in order and call long silences what they are: standing still."""
    out: list[Segment] = []
    clock = 0
    for e in [*episodes, None]:
        begin = e.start if e is not None else frames
        patience = 40 if e is None else 30  # a clip may come to rest for longer than it pauses
        if begin - clock >= patience or (e is None and not out):
            out.append(Segment("stand", start=clock, end=begin))
        if e is not None:
            out.append(e)
            clock = max(clock, e.end)
    return out
