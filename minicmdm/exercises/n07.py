"""The exercises of notebook 07: the causal DiT."""

EXERCISES = ()
