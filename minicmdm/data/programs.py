"""The little language of toy motions: a program is a few segments, each an action with its fields.

A program says only what its sentence says. A field that is `None` was not stated: the synthesiser is free to choose,
and nobody is graded on it. What the synthesiser chose is again a program (every field filled): the *realised* one.
The oracle reads realised programs back from joints, and `agrees` compares what was asked with what was found.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

SIDES = ("left", "right")
SPEEDS = ("slow", "normal", "fast")
OVERLAYS = ("wave_left", "wave_right", "clap", "raise_arms")
DURATIONS = ("short", "normal", "long")
MIN_FRAMES, MAX_FRAMES = 40, 196  # 2 to 9.8 s at 20 fps, multiples of 4: the range HumanML3D trains on


@dataclass(frozen=True)
class Action:
    """What an action can carry: which fields a sentence may state about it."""

    name: str
    side: bool = False  # which hand or leg acts
    direction: bool = False  # which way the body goes
    speed: bool = False
    counted: bool = False
    overlay: bool = False  # arms are free for something else
    sustained: bool = True  # lasts as long as told (False: as long as its repetitions take)
    steps: bool = False  # the feet walk


ACTIONS = {
    action.name: action
    for action in (
        Action("stand"),
        Action("walk", speed=True, overlay=True, steps=True),
        Action("run", steps=True),
        Action("walk_backward", speed=True, overlay=True, steps=True),
        Action("sidestep", direction=True, speed=True, overlay=True, steps=True),
        Action("circle", direction=True, speed=True, overlay=True, steps=True),
        Action("crouch_walk", speed=True, overlay=True, steps=True),
        Action("march", speed=True, overlay=True, steps=True),
        Action("turn", direction=True, sustained=False, steps=True),
        Action("spin", direction=True, sustained=False, steps=True),
        Action("jump", counted=True, sustained=False),
        Action("hop", side=True, counted=True, sustained=False),
        Action("squat", counted=True, speed=True, sustained=False),
        Action("bow", counted=True, speed=True, sustained=False),
        Action("kick", side=True, counted=True, sustained=False),
        Action("punch", side=True, counted=True, sustained=False),
        Action("jumping_jack", counted=True, sustained=False),
        Action("sit", overlay=True),
        Action("wave", side=True, speed=True),
        Action("clap", speed=True),
        Action("raise_arms"),
    )
}


@dataclass(frozen=True)
class Segment:
    """One action and its fields; `None` is "not stated". `start` and `end` are frames, end exclusive."""

    action: str
    side: str | None = None
    direction: str | None = None
    speed: str | None = None
    count: int | None = None
    overlay: str | None = None
    start: int | None = None
    end: int | None = None
    duration: str | None = None  # how long a sustained action was asked to last; not graded

    def to_dict(self) -> dict:
        """The segment as `minicmdm inspect --json` prints it: every graded field, start and end."""
        fields = asdict(self)
        del fields["duration"]
        return fields


Program = tuple[Segment, ...]
FIELDS = ("action", "side", "direction", "speed", "count", "overlay")


def agrees(asked: Segment, found: Segment) -> bool:
    """True when every field that `asked` states is what `found` did."""
    return all(getattr(asked, f) is None or getattr(asked, f) == getattr(found, f) for f in FIELDS)


def score(asked: Program, found: Program) -> tuple[int, int]:
    """(right segments, max(asked, found)): a segment is right when it stands in its place with every stated field.

    The order is the order of the list: a spurious segment at the front makes all that follow wrong.
    """
    right = sum(agrees(a, f) for a, f in zip(asked, found))
    return right, max(len(asked), len(found))


# Two turns in a row would add up to one, and a stand beside a held pose is told apart only by a clock.
_BLURRED = {frozenset(("turn", "spin"))}


def may_follow(first: str, second: str) -> bool:
    """True when two actions can stand side by side without melting into one."""
    return first != second and frozenset((first, second)) not in _BLURRED


def _heldout_pairs() -> frozenset[tuple[str, str]]:
    pairs = [(a, b) for a in ACTIONS for b in ACTIONS if may_follow(a, b)]
    chosen = np.random.default_rng(2026).choice(len(pairs), size=len(pairs) // 10, replace=False)
    return frozenset(pairs[i] for i in chosen)


HELDOUT_PAIRS = _heldout_pairs()  # ordered pairs of neighbours that no training program contains


def pairs_of(program: Program) -> list[tuple[str, str]]:
    """The ordered pairs of neighbouring actions in a program."""
    return [(a.action, b.action) for a, b in zip(program, program[1:])]


def sample_segment(rng: np.random.Generator, name: str) -> Segment:
    """A random segment of the named action, with fields stated as often as people state them."""
    action = ACTIONS[name]
    side = direction = speed = count = overlay = duration = None
    if action.side and rng.random() < 0.85:
        side = SIDES[rng.integers(2)]
    if action.direction and (name == "sidestep" or rng.random() < 0.9):
        direction = SIDES[rng.integers(2)]
    if action.speed and rng.random() < 0.5:
        speed = ("slow", "fast")[rng.integers(2)]
    if action.counted:
        count = int(rng.integers(1, 4))
    if action.overlay and rng.random() < 0.35:
        overlay = OVERLAYS[rng.integers(len(OVERLAYS))]
    if action.sustained and rng.random() < 0.35:
        duration = ("short", "long")[rng.integers(2)]
    return Segment(name, side, direction, speed, count, overlay, duration=duration)


def sample_program(rng: np.random.Generator, heldout: bool = False) -> Program:
    """A random program of one to three segments.

    Training programs (`heldout=False`) contain no pair of `HELDOUT_PAIRS`; with `heldout=True` at least one.
    """
    names = list(ACTIONS)
    while True:
        length = int(rng.choice([1, 2, 3], p=[0.2, 0.4, 0.4])) if not heldout else int(rng.integers(2, 4))
        chosen = [names[i] for i in rng.integers(len(names), size=length)]
        if not all(may_follow(a, b) for a, b in zip(chosen, chosen[1:])):
            continue
        unseen = any(pair in HELDOUT_PAIRS for pair in zip(chosen, chosen[1:]))
        if unseen == heldout:
            return tuple(sample_segment(rng, name) for name in chosen)


def realise(rng: np.random.Generator, segment: Segment) -> Segment:
    """Fill in what the sentence left open: sides and directions at random, the rest at its normal value."""
    action = ACTIONS[segment.action]
    filled = replace(segment, duration=(segment.duration or "normal") if action.sustained else None)
    if action.side and filled.side is None:
        filled = replace(filled, side=SIDES[rng.integers(2)])
    if action.direction and filled.direction is None:
        filled = replace(filled, direction=SIDES[rng.integers(2)])
    if action.speed and filled.speed is None:
        filled = replace(filled, speed="normal")
    return filled
