"""The exercises of notebook 03: the causal VAE."""

EXERCISES = ()
