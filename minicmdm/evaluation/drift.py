"""Two studies of streams: do they still do what they are told after fifty minutes, and how soon?

"drift": sixteen streams in step are told a new test caption every 5 to 10 seconds, each as long as its own clip was.
What stands in a stream's memory is all its own work, and errors might add up; CMDM names that as an open limitation.
Measured: whether every number is finite, how often a joint is further from the pelvis than bones reach, and the
oracle's accuracy in every ten minutes, of which the first and the last are compared. Nothing in the 263 features keeps
a bone's length, so reach and accuracy are measured again ("rigid") with every bone given its length back.

"reaction": a prompt comes while another is acted out, announced by nobody. Latents in flight have begun under the old
one: they may finish as they are ("new"), or hear the new one as well ("active"). Measured: how many frames pass before
the first that has heard it, and how often the oracle then finds what was asked.

`python -m minicmdm.evaluation.studies drift` and `... reaction` run them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import retarget
from minicmdm.data.oracle import read_motion
from minicmdm.data.skeleton import BONE_LENGTHS, FPS, PARENTS
from minicmdm.evaluation import metrics
from minicmdm.evaluation.horizon import Take, answers, draw, follow_all
from minicmdm.pipeline import MotionPipeline

STREAMS, MINUTES, BLOCK = 16, 60, 10
SHORTEST = 5 * FPS  # frames of a prompt; the longest clip has 9.8 s
BEYOND = 0.02  # metres further than its bones reach: a joint's usual error is a centimetre
REACH = np.zeros(len(PARENTS))  # from the pelvis to each joint along the bones
for _joint, _parent in enumerate(PARENTS[1:], start=1):
    REACH[_joint] = REACH[_parent] + BONE_LENGTHS[_joint]
HOW = {"schedule": "fss", "num_steps": 20, "uncertainty": 2, "guidance_scale": 3.0}


def scripts(minutes: int, seed: int = 0) -> list[Take]:
    """What each stream is told: whole captions with their programs, one after the other, drawn from the test set."""
    rng, frames = np.random.default_rng(seed), minutes * 60 * FPS
    clips = [clip for clip in toy_dataset("test", progress=False).clips if len(clip.features) >= SHORTEST]
    takes = []
    for _ in range(STREAMS):
        prompts, cuts = [], [0]
        while cuts[-1] < frames:
            clip = clips[rng.integers(len(clips))]
            prompts.append((clip.program, clip.captions[0]))
            cuts.append(cuts[-1] + len(clip.features))
        takes.append(Take(prompts, np.zeros((cuts[-1] + 1, 0)), list(pairwise(cuts))))
    return takes


@cache
def played(minutes: int) -> list[Take]:
    """The scripts, acted out by the shipped model."""
    return follow_all(MotionPipeline.from_pretrained("toy"), scripts(minutes), list(range(STREAMS)), HOW, "streaming")


def judged(take: Take, minutes: int, block: int) -> dict[str, float]:
    """One stream's numbers: how far joints are, and its accuracy in each `block` minutes, by where a prompt begins."""
    finite = np.isfinite(take.joints).all((1, 2))  # (T,)
    row = {"finite": float(finite.all())}
    held = np.maximum.accumulate(np.where(finite, np.arange(len(finite)), 0))  # what is no number stands still
    take = replace(take, joints=take.joints[held])
    begins = np.array([start for start, _ in take.spans])
    for body, joints in (("", take.joints), ("rigid_", retarget(take.joints, scale_path=False))):
        far = np.linalg.norm(joints - joints[:, :1], axis=-1)  # (T,22)
        row[f"{body}reach_m"] = float(far.max())
        row[f"{body}frames_beyond"] = float((far > REACH + BEYOND).any(1).mean())
        found = answers(replace(take, joints=joints))
        for first in range(0, minutes, block):
            inside = np.flatnonzero((begins >= first * 60 * FPS) & (begins < (first + block) * 60 * FPS))
            asked, done = [take.prompts[k][0] for k in inside], [found[k] for k in inside]
            row[f"{body}minutes {first}-{first + block}"] = metrics.segment_accuracy(asked, done)
    return row


def drift_rows(scratch: Path) -> Iterator[tuple[dict, Callable[[], dict]]]:
    """One row a stream."""
    for number in range(STREAMS):
        yield {"stream": number}, partial(_row, number)


def _row(number: int) -> dict[str, float]:
    return judged(played(MINUTES)[number], MINUTES, BLOCK)


def reaction_rows(scratch: Path) -> Iterator[tuple[dict, Callable[[], dict]]]:
    """One row for each stagger L and each way in which a new prompt reaches latents in flight."""
    for wait in (1, 2, 4, 5, 10, 20):
        for reach in ("new", "active"):
            yield {"L": wait, "new_prompt": reach}, partial(reaction, wait, reach)


def reaction(
    uncertainty: int, new_prompt: str, pairs: int = 128, before: int = 61, after: int = 80
) -> dict[str, float]:
    """Streams are told the first prompt of a pair, and after `before` frames the second, for `after` frames."""
    clips = toy_dataset("test", progress=False).clips
    source = [(segment, said) for clip in clips for segment, (_, _, said) in zip(clip.program, clip.labels)]
    asked = draw(source, pairs, 2, 2, np.random.default_rng(0))
    how = HOW | {"uncertainty": uncertainty, "new_prompt": new_prompt}
    stream = MotionPipeline.from_pretrained("toy").stream([a for (_, a), _ in asked], seed=list(range(pairs)), **how)
    frames = [next(stream) for _ in range(before)]
    wait = stream.reaction
    stream.prompt([b for _, (_, b) in asked], lasts=after)
    joints = np.stack(frames + [next(stream) for _ in range(wait + after)], axis=1)  # (pairs,T,22,3)
    heard = [tuple(s for s in read_motion(one) if (s.start + s.end) / 2 >= before + wait) for one in joints]
    right = metrics.segment_accuracy([(segment,) for _, (segment, _) in asked], heard)
    return {"reaction_frames": float(wait), "oracle_accuracy": right}
