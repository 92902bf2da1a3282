"""What may be asked of a pipeline, and what is said to those who ask for something else."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from minicmdm.diffusion.sampling import SOLVERS
from minicmdm.diffusion.schedules import schedule_matrix

if TYPE_CHECKING:  # slow to import
    from tokenizers import Tokenizer

MIN_FRAMES, MAX_FRAMES = 4, 196  # one latent, and the longest motion of HumanML3D (9.8 s)
MAX_STEPS = 1000
MAX_GUIDANCE = 100.0
# How each system samples unless told: schedule, K and L. The triangle of flood and window has n_s = K / L = 5.
USUAL_SAMPLING = {"cmdm": ("fss", 20, 2), "flood": ("triangular", 10, 2), "window": ("triangular", 10, 2)}


@dataclass(frozen=True)
class Asked:
    """How to sample, each part checked."""

    schedule: str
    num_steps: int
    uncertainty: int
    block_size: int
    guidance_scale: float
    solver: str
    tell_length: bool


def usual_sampling(
    system: str, schedule: str | None, num_steps: int | None, uncertainty: int | None
) -> dict[str, str | int]:
    """A system's own schedule, K and L, but for what is given. Another schedule comes with K = 20 and L = 2.

    Flood and window have learnt triangles of n_s latents, so with another K its L is K / n_s.
    """
    usual = USUAL_SAMPLING[system if schedule is None else "cmdm"]
    if usual[0] == "triangular" and uncertainty is None and isinstance(num_steps, int):
        uncertainty = max(1, num_steps * usual[2] // usual[1])
    given = (schedule, num_steps, uncertainty)
    names = ("schedule", "num_steps", "uncertainty")
    return {name: own if value is None else value for name, value, own in zip(names, given, usual)}


def batches(lengths: list[int], most: int, alike: bool) -> Iterator[list[int]]:
    """The places of lengths that are sampled together, at most `most`: near each other or, with `alike`, the same."""
    order = sorted(range(len(lengths)), key=lengths.__getitem__)
    for _, group in groupby(order, lengths.__getitem__ if alike else lambda _: None):
        together = list(group)
        yield from (together[first : first + most] for first in range(0, len(together), most))


def sampling_of(
    pipe: object, schedule: str | None, num_steps: int | None, uncertainty: int | None
) -> dict[str, str | int]:
    """How a pipeline samples, but for what is given. Whoever answers in its place is asked as CMDM is."""
    own = getattr(pipe, "sampling", partial(usual_sampling, "cmdm"))
    return own(schedule, num_steps, uncertainty)


def check_sampling(
    schedule: str, num_steps: int, uncertainty: int, block_size: int, guidance_scale: float, solver: str, tell: bool
) -> Asked:
    """All that says how to sample. ValueError: what cannot be asked."""
    num_steps = integer(num_steps, "num_steps", 1, MAX_STEPS)
    scale = check_guidance(guidance_scale)
    block_size = integer(block_size, "block_size", 1, 49)
    schedule_matrix(1, num_steps, uncertainty, block_size, schedule)  # refuse a bad schedule before any work
    if solver not in SOLVERS:
        raise ValueError(f"unknown solver {solver!r}: expected one of {', '.join(SOLVERS)}")
    return Asked(schedule, num_steps, uncertainty, block_size, scale, solver, tell)


def check_prompt(prompt: object, tokenizer: Tokenizer) -> None:
    """A sentence that this tokenizer can read whole. ValueError: anything else."""
    if not isinstance(prompt, str):
        raise ValueError(f"a prompt must be a string, like 'a person walks', and {type(prompt).__name__} came")
    if not prompt.strip():
        raise ValueError("the prompt is empty: say what to do, like 'a person walks, then waves'")
    try:
        prompt.encode("utf-8")
    except UnicodeEncodeError as error:
        raise ValueError("the prompt holds bytes that are no text in this locale's encoding") from error
    encoding = tokenizer.encode(prompt)
    if encoding.overflowing:
        total = len(encoding.ids) + sum(len(rest.ids) for rest in encoding.overflowing)
        raise ValueError(f"the prompt is too long: about {total} word pieces, and the longest is {len(encoding.ids)}")


def as_list(value: object, name: str, expected: str) -> list:
    """A list or tuple that is not empty, as a list. ValueError: anything else."""
    if not isinstance(value, (list, tuple)) or not value:
        what = "an empty list" if isinstance(value, (list, tuple)) else type(value).__name__
        raise ValueError(f"{name} must be {expected}, and {what} came")
    return list(value)


def spread(value: object, count: int, name: str) -> list:
    """One value for all prompts, or a list with one for each."""
    if not isinstance(value, (list, tuple, np.ndarray)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name}: {count} prompts need one value or {count}, and {len(value)} came")
    return list(value)


def integer(value: object, name: str, low: int, high: int) -> int:
    """A whole number from low to high. ValueError: anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, and {value!r} came")
    return int(value)


def check_frames(value: object) -> int:
    """A motion's length. ValueError: too short, too long, or no whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not MIN_FRAMES <= value <= MAX_FRAMES:
        raise ValueError(
            f"num_frames must be a whole number from {MIN_FRAMES} (0.2 s) to {MAX_FRAMES} (9.8 s, the longest), "
            f"and {value!r} came"
        )
    return int(value)


def check_guidance(value: object) -> float:
    """A guidance scale. ValueError: no finite number from 0 to MAX_GUIDANCE."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not 0 <= value <= MAX_GUIDANCE:
        raise ValueError(f"guidance_scale must be a number from 0 to {MAX_GUIDANCE:.0f} (1 is off), and {value!r} came")
    return float(value)
