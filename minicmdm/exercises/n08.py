"""The exercises of notebook 08: the schedule matrix."""

EXERCISES = ()
