"""The exercises of notebook 06: diffusion forcing."""

EXERCISES = ()
