"""The exercises of notebook 04: alignment."""

EXERCISES = ()
