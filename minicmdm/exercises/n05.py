"""The exercises of notebook 05: diffusion and flow."""

EXERCISES = ()
