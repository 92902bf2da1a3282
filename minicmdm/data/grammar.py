"""Program → English: the same program said in many ways.

A phrase is "verb|rest": the verb is kept apart because a sentence may need it as "walks" or as "walking". Marks in the
rest are filled from the segment: {s} side, {d} direction, {n} "twice", {k} "two" (and {p} the plural s), {w} clockwise.
The second list of each action is kept for the test split: words a reader has met, in a company it has not.
"""

from __future__ import annotations

import re

import numpy as np

from minicmdm.data.programs import ACTIONS, Program, Segment

# action: ([phrases for training], [phrases kept for the test])
PHRASES: dict[str, tuple[list[str], list[str]]] = {
    "stand": (["stand|still", "stand|", "wait|", "pause|", "stay|still", "do|nothing"], ["wait|still"]),
    "walk": (
        [
            "walk|",
            "walk|forward",
            "stroll|",
            "stroll|ahead",
            "step|forward",
            "go|for a walk",
            "walk|straight",
        ],
        ["stroll|forward", "walk|straight ahead"],
    ),
    "run": (
        ["run|", "run|forward", "jog|", "jog|ahead", "dash|forward", "sprint|"],
        ["jog|forward", "sprint|ahead"],
    ),
    "walk_backward": (
        ["walk|backwards", "step|backwards", "walk|in reverse", "back|up", "move|back", "go|backwards"],
        ["move|backwards", "step|back"],
    ),
    "sidestep": (
        ["sidestep|to the {d}", "step|sideways to the {d}", "shuffle|to the {d}", "move|sideways to the {d}"],
        ["shuffle|sideways to the {d}", "sidestep|{d}"],
    ),
    "circle": (
        [
            "walk|in a circle to the {d}",
            "circle|around to the {d}",
            "go|around in a circle to the {d}",
            "walk|in a {w} circle",
            "loop|around to the {d}",
        ],
        ["loop|around in a circle to the {d}", "go|in a {w} circle"],
    ),
    "crouch_walk": (
        [
            "walk|in a crouch",
            "creep|forward",
            "sneak|forward",
            "walk|crouched low",
            "sneak|ahead",
            "crouch|and walk",
        ],
        ["creep|ahead", "sneak|ahead crouched low"],
    ),
    "march": (
        ["march|in place", "march|on the spot", "step|in place", "walk|on the spot", "march|without moving"],
        ["walk|in place", "step|on the spot"],
    ),
    "turn": (
        ["turn|to the {d}", "turn|{d}", "rotate|to the {d}", "pivot|to the {d}", "face|{d}"],
        ["pivot|{d}", "rotate|{d}"],
    ),
    "spin": (
        ["spin|around to the {d}", "spin|{d}", "twirl|to the {d}", "do|a full turn to the {d}", "spin|{w}"],
        ["twirl|around to the {d}", "do|a full spin to the {d}"],
    ),
    "jump": (
        [
            "jump|{n}",
            "jump|up {n}",
            "leap|up {n}",
            "jump|into the air {n}",
            "do|{k} jump{p}",
            "make|{k} jump{p}",
        ],
        ["leap|into the air {n}", "do|{k} leap{p}"],
    ),
    "hop": (
        [
            "hop|on the {s} leg {n}",
            "hop|{n} on the {s} foot",
            "bounce|on the {s} leg {n}",
            "do|{k} hop{p} on the {s} leg",
        ],
        ["bounce|{n} on the {s} foot", "make|{k} hop{p} on the {s} foot"],
    ),
    "squat": (
        ["squat|{n}", "squat|down {n}", "do|{k} squat{p}", "bend|the knees {n}", "perform|{k} squat{p}"],
        ["make|{k} squat{p}", "bend|down the knees {n}"],
    ),
    "bow": (
        ["bow|{n}", "bow|down {n}", "bend|forward {n}", "take|{k} bow{p}", "lean|over {n}", "bend|over {n}"],
        ["lean|forward {n}", "make|{k} bow{p}"],
    ),
    "kick": (
        [
            "kick|with the {s} leg {n}",
            "kick|{n} with the {s} foot",
            "throw|{k} kick{p} with the {s} leg",
            "do|{k} {s} kick{p}",
        ],
        ["kick|with the {s} foot {n}", "perform|{k} kick{p} with the {s} leg"],
    ),
    "punch": (
        [
            "punch|with the {s} hand {n}",
            "punch|{n} with the {s} arm",
            "throw|{k} {s} punch{p}",
            "jab|with the {s} fist {n}",
        ],
        ["jab|{n} with the {s} hand", "throw|{k} punch{p} with the {s} fist"],
    ),
    "jumping_jack": (
        ["do|{k} jumping jack{p}", "perform|{k} jumping jack{p}", "do|{k} star jump{p}"],
        ["make|{k} jumping jack{p}", "perform|{k} star jump{p}"],
    ),
    "sit": (
        ["sit|down", "sit|", "take|a seat", "sit|on a chair", "have|a seat"],
        ["take|a chair", "sit|down on a chair"],
    ),
    "wave": (
        [
            "wave|the {s} hand",
            "wave|with the {s} hand",
            "wave|with the {s} arm",
            "say|hello with the {s} hand",
            "greet|with the {s} hand",
        ],
        ["greet|with the {s} arm", "wave|hello with the {s} hand"],
    ),
    "clap": (
        ["clap|", "clap|both hands", "applaud|", "clap|the hands together"],
        ["clap|both hands together", "clap|together"],
    ),
    "raise_arms": (
        [
            "raise|both arms",
            "lift|both arms up",
            "put|both hands up",
            "hold|both hands overhead",
            "reach|up with both arms",
        ],
        ["raise|both hands overhead", "lift|both hands up"],
    ),
}
# What is said when neither side nor direction is stated.
FREE: dict[str, list[str]] = {
    "circle": ["walk|in a circle", "circle|around"],
    "turn": ["turn|to the side", "turn|sideways"],
    "spin": ["spin|around", "do|a full turn", "twirl|"],
    "hop": ["hop|on one leg {n}", "hop|{n}", "do|{k} hop{p}"],
    "kick": ["kick|{n}", "throw|{k} kick{p}"],
    "punch": ["punch|{n}", "throw|{k} punch{p}"],
    "wave": ["wave|", "wave|hello", "wave|one hand"],
}
SPEED_WORDS = {
    "slow": ["slowly", "at a slow pace", "calmly", "leisurely", "in slow motion"],
    "fast": ["quickly", "fast", "rapidly", "at a fast pace", "in a hurry", "briskly"],
}
DURATION_WORDS = {
    "short": ["briefly", "for a moment", "for a short while"],
    "long": ["for a long time", "for a good while", "for several seconds"],
}
OVERLAY_WORDS = {
    "wave_left": [
        "while waving the left hand",
        "waving with the left hand",
        "while greeting with the left arm",
    ],
    "wave_right": [
        "while waving the right hand",
        "waving with the right hand",
        "while greeting with the right arm",
    ],
    "clap": ["while clapping", "clapping both hands", "while applauding"],
    "raise_arms": [
        "with both arms raised",
        "with both hands up",
        "holding both arms overhead",
        "while raising both arms",
    ],
}
TIMES = {1: ["", "once", "one time"], 2: ["twice", "two times"], 3: ["three times", "thrice"]}
NUMBERS = {1: ["one", "a", "a single"], 2: ["two", "a couple of"], 3: ["three"]}
SUBJECTS = (
    "a person|someone|a man|a woman|the person|the figure|a figure|a human|a dancer|the actor|an actor|a child|"
    "a boy|a girl|the man|the woman|somebody|he|she"
).split("|")
THEN = [
    ", then {}",
    " and then {}",
    ", after that {}",
    ", next {}",
    " and afterwards {}",
    ". then {}",
    ", and later {}",
]
THEN_HELD = [" and after that {}", ", afterwards {}"]
LAST = [", and finally {}", " and finally {}", ", and at the end {}"]


def _third(verb: str) -> str:
    irregular = {"do": "does", "go": "goes", "have": "has", "say": "says", "stay": "stays", "sway": "sways"}
    if verb in irregular:
        return irregular[verb]
    return verb + "es" if verb.endswith(("ch", "sh", "ss")) else verb + "s"


def _gerund(verb: str) -> str:
    if verb in {"jog", "run", "step", "spin", "hop", "squat", "sit", "jab", "clap", "put", "sidestep"}:
        return verb + verb[-1] + "ing"
    return verb[:-1] + "ing" if verb.endswith("e") and not verb.endswith("ee") else verb + "ing"


def _pick(rng: np.random.Generator, options: list[str]) -> str:
    return options[rng.integers(len(options))]


def clause(rng: np.random.Generator, segment: Segment, form: str = "third", heldout: bool = False) -> str:
    """One segment as a verb phrase, "walks slowly" (`form="third"`) or "walking slowly" (`form="gerund"`)."""
    action = ACTIONS[segment.action]
    free = (action.side and segment.side is None) or (action.direction and segment.direction is None)
    phrases = FREE[segment.action] if free else PHRASES[segment.action][1 if heldout else 0]
    phrase = _pick(rng, phrases)
    verb, rest = phrase.split("|")
    if segment.count is not None:
        rest = rest.replace("{n}", _pick(rng, TIMES[segment.count])).replace("{k}", _pick(rng, NUMBERS[segment.count]))
        rest = re.sub(r"(\w+)\{p\}", lambda m: _third(m[1]) if segment.count > 1 else m[1], rest)
    turn = {"left": "counterclockwise", "right": "clockwise"}.get(segment.direction, "")
    rest = rest.replace("{s}", segment.side or "").replace("{d}", segment.direction or "").replace("{w}", turn)
    verb = _third(verb) if form == "third" else _gerund(verb)
    rest = re.sub(r"\band walk\b", "and walks" if form == "third" else "and walking", rest)
    words = [verb, rest]
    if segment.speed in SPEED_WORDS:
        adverb = _pick(rng, SPEED_WORDS[segment.speed])
        before = len(adverb.split()) == 1 and adverb != "fast" and rng.random() < 0.35
        words.insert(0 if before else 2, adverb)
    if segment.duration in DURATION_WORDS:
        words.append(_pick(rng, DURATION_WORDS[segment.duration]))
    if segment.overlay is not None:
        words.append(_pick(rng, OVERLAY_WORDS[segment.overlay]))
    return " ".join(" ".join(words).split())


def sentence(rng: np.random.Generator, segment: Segment, heldout: bool = False) -> str:
    """One segment as a sentence of its own: "a person walks slowly"."""
    return f"{_pick(rng, SUBJECTS)} {clause(rng, segment, heldout=heldout)}"


def caption(rng: np.random.Generator, program: Program, heldout: bool = False) -> str:
    """The whole program as one sentence; `heldout=True` uses the phrases kept for the test split.

    Two-part programs are sometimes told backwards ("waves after walking"), so that the order of the words is not
    the order of the deeds.
    """
    subject = _pick(rng, SUBJECTS)
    if len(program) == 2 and rng.random() < 0.2:
        first, second = program
        style = rng.integers(3)
        if style == 0:
            tail = f"{clause(rng, second, heldout=heldout)} after {clause(rng, first, 'gerund', heldout)}"
            return f"{subject} {tail}"
        if style == 1:
            return f"after {clause(rng, first, 'gerund', heldout)}, {subject} {clause(rng, second, heldout=heldout)}"
        return f"{subject} {clause(rng, first, heldout=heldout)} before {clause(rng, second, 'gerund', heldout)}"
    text = f"{subject} " + ("first " if len(program) > 1 and rng.random() < 0.15 else "")
    for i, segment in enumerate(program):
        part = clause(rng, segment, heldout=heldout)
        if i == 0:
            text += part
        elif i == 2 and rng.random() < 0.4:
            text += _pick(rng, LAST).format(part)
        else:
            text += _pick(rng, THEN_HELD if heldout else THEN).format(part)
    return text
