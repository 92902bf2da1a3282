"""The exercises of notebook 01: motion as data."""

EXERCISES = ()
