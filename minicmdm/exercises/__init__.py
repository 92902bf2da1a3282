"""The notebooks' exercises: a module for each notebook, and the frame that puts an answer to the proof."""

from minicmdm.exercises import n00, n01, n02, n03, n04, n05, n06, n07, n08, n09, n10, n11, n12, n13, n14, n15
from minicmdm.exercises.frame import Exercise, budget, check, expect, hint, must, solution

__all__ = ["EXERCISES", "Exercise", "budget", "check", "expect", "hint", "must", "solution"]

_NOTEBOOKS = (n00, n01, n02, n03, n04, n05, n06, n07, n08, n09, n10, n11, n12, n13, n14, n15)
EXERCISES = {exercise.id: exercise for notebook in _NOTEBOOKS for exercise in notebook.EXERCISES}
