"""The exercises of notebook 02: causality."""

EXERCISES = ()
