"""The exercises of notebook 15: scale up."""

EXERCISES = ()
