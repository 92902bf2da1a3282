"""An hour without an end: does a stream still do what it is told after fifty minutes?

Eight streams in step are told a new test caption every 5 to 10 seconds, each as long as its own clip was. What stands
in a stream's memory is all its own work, and errors might add up; CMDM names that as an open limitation. Measured: no
number is lost, no joint is further from the pelvis than a skeleton reaches, and the oracle's accuracy in every ten
minutes, of which the first and the last are compared.

`python -m minicmdm.evaluation.studies drift` runs it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from minicmdm.data.dataset import toy_dataset
from minicmdm.data.skeleton import FPS
from minicmdm.evaluation import metrics
from minicmdm.evaluation.horizon import Take, answers, follow_all
from minicmdm.pipeline import MotionPipeline

STREAMS, MINUTES, BLOCK = 8, 60, 10
SHORTEST = 5 * FPS  # frames of a prompt; the longest clip has 9.8 s
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
    """One stream's numbers: its farthest reach, and its accuracy in each `block` minutes, by where a prompt begins."""
    reach = np.linalg.norm(take.joints - take.joints[:, :1], axis=-1).max()
    row = {"finite": float(np.isfinite(take.joints).all()), "reach_m": float(reach)}
    found = answers(replace(take, joints=np.nan_to_num(take.joints)))  # the oracle refuses what is no number
    begins = np.array([start for start, _ in take.spans])
    for first in range(0, minutes, block):
        inside = np.flatnonzero((begins >= first * 60 * FPS) & (begins < (first + block) * 60 * FPS))
        asked, done = [take.prompts[k][0] for k in inside], [found[k] for k in inside]
        row[f"minutes {first}-{first + block}"] = metrics.segment_accuracy(asked, done)
    return row


def drift_rows(scratch: Path) -> Iterator[tuple[dict, Callable[[], dict]]]:
    """One row a stream."""
    for number in range(STREAMS):
        yield {"stream": number}, partial(_row, number)


def _row(number: int) -> dict[str, float]:
    return judged(played(MINUTES)[number], MINUTES, BLOCK)
