"""The exercises of notebook 10: evaluation."""

EXERCISES = ()
