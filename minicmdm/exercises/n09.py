"""The exercises of notebook 09: sampling and streaming."""

EXERCISES = ()
