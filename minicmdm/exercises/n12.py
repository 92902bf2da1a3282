"""The exercises of notebook 12: the triangle's clocks, its window in whole numbers, three targets of training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from minicmdm.diffusion.path import interpolate, velocity
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.exercises.frame import Exercise, must
from minicmdm.systems.flood import last_moment, to_velocity, triangle

PLANS = [(1, 1), (2, 1), (2, 2), (3, 2), (5, 5), (4, 6)]  # latents, overlap; then random larger ones


def _plans(seed: int) -> list[tuple[int, int]]:
    rng = np.random.default_rng(seed)
    return PLANS + sorted((int(rng.integers(6, 30)), int(rng.integers(2, 13))) for _ in range(5))


def _prove_triangle(answer: Callable) -> None:
    rng = np.random.default_rng(1)
    for latents, overlap in _plans(1):
        end = last_moment(latents, overlap)

        def times(moment: float, latents=latents, overlap=overlap) -> np.ndarray:
            t = np.asarray(answer(moment, latents, overlap), dtype=float)
            must(t.shape == (latents,), f"One time for each of {latents} latents.")
            return t

        must((times(0.0) == 0).all(), "Before anything moves all latents are noise: t = 0.")
        must(np.allclose(times(end), 1), f"At {end:.2f} = 1 + (N-1)/n_s the last latent is clean, and so are all.")
        for moment in sorted(rng.uniform(0, end, 4).tolist()):
            t = times(moment)
            must(((t >= 0) & (t <= 1)).all(), "Times stay between 0 and 1: clamp them.")
            must(abs(t[0] - min(moment, 1)) < 1e-6, "The first latent's clock is the moment itself, up to 1.")
            must((np.diff(t) <= 1e-9).all(), "A latent is never ahead of its left neighbour.")
            right = np.array([min(max(moment - k / overlap, 0), 1) for k in range(latents)])
            law = f"Latent k starts k / n_s = k / {overlap} after latent 0, and then all go at the same pace."
            must(np.allclose(t, right, atol=1e-6), law)


def window_of_call(call: int, num_latents: int, num_steps: int, overlap: int) -> tuple[int, int]:
    """The latents first, ..., end-1 that the step after `call` calls moves; num_steps K is a multiple of n_s."""
    started = call * overlap // num_steps + 1  # floor(s n_s) + 1 at the moment s = call / K
    finished = (call - num_steps) * overlap // num_steps + 1  # floor((s - 1) n_s) + 1; // rounds down below 0 as well
    return max(0, finished), min(num_latents, started)


def _prove_window(answer: Callable) -> None:
    for size, (latents, overlap) in enumerate(_plans(2)):
        steps = overlap * (1 + size % 4)
        matrix = schedule_matrix(latents, steps, kind="triangular", overlap=overlap)
        for call, (before, after) in enumerate(zip(matrix, matrix[1:])):
            first, end = (int(i) for i in answer(call, latents, steps, overlap))
            here, moved = f"K = {steps}, after {call} calls", np.flatnonzero(after < before)
            must(first >= 0 and end <= latents, f"There are latents 0 to {latents - 1} only: bound the window.")
            law = f"{here}: finished latents, at level 0, never move again, and the others have to."
            must(first == moved[0], f"{law} Latent {moved[0]} is the first at {before[moved[0]]}.")
            law = f"{here}: latent {moved[-1]} makes a step now (it stands at level {before[moved[-1]]}), no later one."
            must(end == moved[-1] + 1, law)


def _prove_velocity(answer: Callable) -> None:
    for size, shape in enumerate([(1, 1, 1), (1, 3, 1), (2, 4, 3), (3, 9, 2)]):
        luck = torch.Generator().manual_seed(size)
        z, eps, guess = torch.randn(3, *shape, generator=luck, dtype=torch.float64)
        t = 0.05 + 0.9 * torch.rand(shape[:2], generator=luck, dtype=torch.float64)
        z_t, v = interpolate(z, eps, t), velocity(z, eps)
        for target, perfect in {"v": v, "x0": z, "eps": eps}.items():
            found = answer(perfect, target, z_t, t)
            must(found.shape == z.shape, "A velocity for every channel of every latent, (B,N,C).")
            must(torch.allclose(found, v), f"A perfect prediction of {target} stands for the velocity z - eps.")
            law = f"A wrong prediction of {target} stands for the velocity that leads from eps to z by way of z_t."
            must(torch.allclose(answer(guess, target, z_t, t), to_velocity(guess, target, z_t, t)), law)
        ends = t.clone()
        ends[:, 0], ends[:, -1] = 1.0, 0.0  # one that is finished, one that begins (the same, if there is but one)
        z_t = interpolate(z, eps, ends)
        must(answer(guess, "eps", z_t, ends).isfinite().all(), "At t = 0, too, predicted noise needs a finite answer.")
        ends[:, -1] = 1.0
        found = answer(guess, "x0", interpolate(z, eps, ends), ends)
        must((found[:, [0, -1]] == 0).all(), "Where t = 1 a latent is finished: whatever the network says, it rests.")


EXERCISES = (
    Exercise(
        "12.1",
        "torch.arange(num_latents) / overlap says when each latent starts; clamp what is left of the moment.",
        triangle,
        _prove_triangle,
    ),
    Exercise(
        "12.2",
        "the moment is call / K. Write both floors as whole divisions: // rounds down below zero too, int() does not.",
        window_of_call,
        _prove_window,
    ),
    Exercise(
        "12.3",
        "z_t = t z + (1-t) eps and v = z - eps: solve for v with z known, then with eps known. t[..., None] meets the "
        "channels, clamp keeps a divisor from 0, torch.where chooses.",
        to_velocity,
        _prove_velocity,
    ),
)
