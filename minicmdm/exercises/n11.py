"""The exercises of notebook 11: long horizon."""

EXERCISES = ()
