"""The frame of the exercises: check an answer, ask for a hint, read the solution; and two helpers for training.

    check("00.1", my_shapes)     not attempted: prints the hint · wrong: AssertionError · right: a short line
    hint("00.1")                 the hint alone
    solution("00.1")             the source of the function that the library itself would use

A stub ends with `return ...`, and as long as an answer returns `...` (or something that still contains it), nothing is
wrong: the reader has not been there yet. An exercise is an `Exercise`: how it is proved is a function that calls the
answer on cases of growing size and says `must(condition, property)`, so that the first failure is the smallest.

Runtime switches, for whoever runs the gates: MINICMDM_FAST=1 shortens training, MINICMDM_SOLUTIONS=0 hides solutions.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Exercise:
    """One exercise: its hint, the reference that `solution` prints, and the proof that `check` puts an answer to."""

    id: str  # notebook, dot, number: "08.1"
    hint: str
    reference: Callable
    prove: Callable[[Callable], None]  # calls the answer; AssertionError (see `must`) with the property that broke


class NotAttempted(Exception):
    """The answer still holds its `...`."""


def check(id: str, answer: Callable) -> None:
    """Put an answer to the proof: prints the hint if it is untouched, one line if it is right.

    AssertionError: it is wrong, with the smallest failing call, what came of it, and the property that breaks.
    """
    exercise = _find(id)
    if answer is None or answer is ...:
        return print(f"Exercise {id} is not attempted yet. Hint: {exercise.hint}")
    if not callable(answer):
        raise AssertionError(f"exercise {id} expects a function, and {type(answer).__name__} came")
    last = "the answer was never called"

    def watched(*arguments):
        nonlocal last
        call = f"{getattr(answer, '__name__', 'answer')}({', '.join(map(_brief, arguments))})"
        try:
            value = answer(*arguments)
        except NotImplementedError:
            raise NotAttempted from None
        except Exception as error:
            raise AssertionError(f"{call} raises {type(error).__name__}: {error}") from error
        if _holds_ellipsis(value):
            raise NotAttempted
        last = f"{call} gives {_brief(value)}" + (", is a `return` missing?" if value is None else "")
        return value

    try:
        exercise.prove(watched)
    except NotAttempted:
        return print(f"Exercise {id} is not attempted yet. Hint: {exercise.hint}")
    except AssertionError as error:
        if error.__cause__ is not None:  # the answer itself raised: its own traceback helps most
            raise
        raise AssertionError(f"{last}. {error}") from None
    except (TypeError, ValueError, IndexError) as error:  # the proof could not even read what came
        raise AssertionError(f"{last}, which cannot be read as the answer ({error}). {exercise.hint}") from None
    print(f"Exercise {id}: right.")


def hint(id: str) -> None:
    """Print an exercise's hint."""
    print(_find(id).hint)


def solution(id: str) -> None:
    """Print the source of an exercise's reference, unless MINICMDM_SOLUTIONS=0 hides it."""
    reference = _find(id).reference
    if os.environ.get("MINICMDM_SOLUTIONS") == "0":
        return print(f"Solutions are hidden here (MINICMDM_SOLUTIONS=0). hint({id!r}) may help.")
    print(inspect.getsource(reference))


def must(condition: object, law: str) -> None:
    """Assert a property in words (and unlike `assert`, also under `python -O`)."""
    if not condition:
        raise AssertionError(law)


def budget(full: int, fast: int) -> int:
    """How many steps to train: `full`, or `fast` where MINICMDM_FAST=1."""
    return fast if _fast() else full


def expect(condition: object, text: str) -> None:
    """Assert at full size what only a trained model shows; say that it is skipped where MINICMDM_FAST=1."""
    if _fast():
        return print(f"skipped in fast mode: {text}")
    must(condition, f"expected, and not found: {text}")
    print(f"as expected: {text}")


def _fast() -> bool:
    return os.environ.get("MINICMDM_FAST") == "1"


def _find(id: str) -> Exercise:
    from minicmdm.exercises import EXERCISES  # here, as the exercises themselves stand on this frame

    if id not in EXERCISES:
        raise ValueError(f"there is no exercise {id!r}: expected one of {', '.join(EXERCISES)}")
    return EXERCISES[id]


def _holds_ellipsis(value: object) -> bool:
    if isinstance(value, dict):
        value = list(value.values())
    return value is ... or (isinstance(value, (tuple, list)) and any(map(_holds_ellipsis, value)))


def _brief(value: object) -> str:
    shape = getattr(value, "shape", None)
    if shape is not None and np.prod(shape) > 12:
        return f"<{type(value).__name__} of shape {tuple(shape)}>"
    text = " ".join(repr(value).split())
    return text if len(text) <= 200 else text[:197] + "..."


def sizes(low: int, high: int, count: int = 12) -> list[int]:
    """The smallest sizes, one by one, and then random larger ones in order."""
    rng = np.random.default_rng(0)
    return [*range(low, low + 6), *sorted(rng.integers(low + 6, high + 1, size=count).tolist())]
