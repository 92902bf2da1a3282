"""The exercises of notebook 05: the noisy latent, data from a velocity, DDPM's posterior step, Euler's step."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from minicmdm.diffusion.path import alpha_bar_to_time, ddim_step, euler_step, interpolate, velocity_to_data
from minicmdm.exercises.frame import Exercise, must

SHAPES = ((1, 1, 1), (2, 1, 2), (2, 3, 4), (4, 3, 3), (3, 7, 5))  # batch, latents, channels


def _cases() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Data and noise (B,N,C) and a time for each latent (B,N) in (0,1), of growing size."""
    for seed, (batch, latents, channels) in enumerate(SHAPES):
        luck = torch.Generator().manual_seed(seed)
        z, eps = (torch.randn(batch, latents, channels, generator=luck, dtype=torch.float64) for _ in range(2))
        yield z, eps, 0.1 + 0.8 * torch.rand(batch, latents, generator=luck, dtype=torch.float64)


def _close(a: Tensor, b: Tensor) -> bool:
    return torch.is_tensor(a) and a.shape == b.shape and torch.allclose(a, b.to(a), rtol=1e-7, atol=1e-9)


def _prove_interpolate(answer: Callable) -> None:
    for z, eps, t in _cases():
        must(
            _close(answer(z, eps, torch.ones_like(t)), z), "At t = 1 nothing is left of the noise: z itself comes back."
        )
        must(_close(answer(z, eps, torch.zeros_like(t)), eps), "At t = 0 there is only noise: eps itself comes back.")
        z_t = answer(z, eps, t)
        must(torch.is_tensor(z_t) and z_t.shape == z.shape, "The noisy latents have the shape of the latents, (B,N,C).")
        must(
            _close(answer(eps, z, t), z + eps - z_t),
            "Data and noise share by t and 1 - t, so both orders add up to z + eps.",
        )
        must(
            _close(z_t, interpolate(z, eps, t)), "Every latent (b, n) mixes by its own t[b, n], all its channels alike."
        )


def _prove_data(answer: Callable) -> None:
    for z, eps, t in _cases():
        v, z_t = z - eps, interpolate(z, eps, t)
        ends = answer(z, v, torch.ones_like(t))
        must(_close(ends, z), "At t = 1 the latent has arrived: whatever v says, it stays where it is.")
        must(
            _close(answer(eps, v, torch.zeros_like(t)), z),
            "At t = 0 the whole way is still to go: noise plus v is the data.",
        )
        must(_close(answer(z_t, v, t), z), "From any point of its line, the true velocity leads to the data z.")


def ddpm_posterior(x: Tensor, z: Tensor, abar_from: float, abar_to: float) -> tuple[Tensor, float]:
    """Mean (B,N,C) and variance of the next, cleaner x, given x and its clean end z (Ho et al. 2020, Eqs 6-7)."""
    alpha = abar_from / abar_to  # how much signal this one step took away, as a share of squares
    mean = alpha**0.5 * (1 - abar_to) * x + abar_to**0.5 * (1 - alpha) * z
    return mean / (1 - abar_from), (1 - abar_to) * (1 - alpha) / (1 - abar_from)


def _prove_posterior(answer: Callable) -> None:
    levels = [(0.5, 1.0), (0.3, 0.6), (0.5, 0.55), (0.1, 0.9), (0.01, 0.4)]  # abar before and after the step
    for (z, eps, _), (abar, abar_to) in zip(_cases(), levels):
        mean, variance = answer(z * abar**0.5, z, abar, abar_to)
        must(torch.is_tensor(mean) and mean.shape == z.shape, "The mean has the shape of x, (B,N,C).")
        law = "x without any noise steps to sqrt(abar_to) z, which again has none."
        must(_close(mean, z * abar_to**0.5), law)
        variance = float(variance)
        mean, _ = answer(z * abar**0.5 + eps * (1 - abar) ** 0.5, z, abar, abar_to)
        kept = float(((mean - z * abar_to**0.5) / eps).mean())  # how much of eps is still there
        law = f"The old noise that is kept ({kept:.3f} of eps) and the new must together have variance 1 - abar_to."
        must(abs(kept**2 + variance - (1 - abar_to)) < 1e-9, law)
        times = [alpha_bar_to_time(torch.tensor(a, dtype=torch.float64)) for a in (abar, abar_to)]
        s, s_to = (a**0.5 + (1 - a) ** 0.5 for a in (abar, abar_to))  # the library steps on the straight path
        z_t = (z * abar**0.5 + eps * (1 - abar) ** 0.5) / s
        library = s_to * ddim_step(z_t, z - eps, *times, eta=1.0, fresh=torch.zeros_like(z))
        must(
            _close(mean, library),
            "The mean is that of the product of the two Gaussians, where the library's step goes.",
        )


def _prove_euler(answer: Callable) -> None:
    for z, eps, t in _cases():
        v, z_t, ones = z - eps, interpolate(z, eps, t), torch.ones_like(t)
        must(
            _close(answer(z_t, v, t, ones), z),
            "On a straight line one step to t = 1, along the true v, ends at the data.",
        )
        must(_close(answer(z_t, v, t, 0 * t), eps), "One step back to t = 0 ends at the noise: a step has a sign.")
        halfway = answer(z_t, v, t, (t + 1) / 2)
        must(
            _close(halfway, interpolate(z, eps, (t + 1) / 2)),
            "A step along v of length t_to - t_from stays on the line.",
        )
        still = torch.arange(t.shape[1]) % 2 == 0  # these latents wait
        stepped = answer(z_t, torch.where(still[:, None], torch.nan, v), t, torch.where(still, t, ones))
        must(
            torch.equal(stepped[:, still], z_t[:, still]), "A latent with t_to = t_from is copied, though its v is NaN."
        )
        must(_close(stepped[:, ~still], z[:, ~still]), "While some latents wait, the others take their step.")


EXERCISES = (
    Exercise(
        "05.1",
        "t is (B,N) and z is (B,N,C): give t one more axis at its end, then z_t = t z + (1 - t) eps.",
        interpolate,
        _prove_interpolate,
    ),
    Exercise(
        "05.2",
        "along the line z_t moves by v for each unit of time; how much time is left?",
        velocity_to_data,
        _prove_data,
    ),
    Exercise(
        "05.3",
        "with alpha = abar_from / abar_to, two Gaussians in the new x are multiplied: N(sqrt(abar_to) z, 1 - abar_to), "
        "and the step backwards, N(x / sqrt(alpha), (1 - alpha) / alpha). Precisions, 1 / variance, add up.",
        ddpm_posterior,
        _prove_posterior,
    ),
    Exercise(
        "05.4",
        "the step is v times (t_to - t_from); and 0 * NaN is NaN, so choose with torch.where instead of multiplying.",
        euler_step,
        _prove_euler,
    ),
)
