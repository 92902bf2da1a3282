"""The exercises of notebook 06: noise by per-latent level, times with a mask, the masked loss."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.diffusion.path import interpolate, level_to_time
from minicmdm.exercises.frame import Exercise, must

SHAPES = ((1, 1, 1), (1, 2, 1), (2, 3, 2), (3, 5, 4), (2, 8, 3))  # batch, latents, channels


def noise_by_level(z: Tensor, eps: Tensor, level: Tensor, num_steps: int) -> Tensor:
    """Clean latents z and noise eps (B,N,C), levels (B,N) from 0 (clean) to num_steps (noise) -> noisy latents."""
    return interpolate(z, eps, level_to_time(level.to(z), num_steps))


def _prove_noise(answer: Callable) -> None:
    for size, (batch, latents, channels) in enumerate(SHAPES):
        luck, top = torch.Generator().manual_seed(size), 4 + 3 * size
        z, eps = torch.randn(2, batch, latents, channels, generator=luck).double()
        level = torch.randint(top + 1, (batch, latents), generator=luck)
        must(torch.allclose(answer(z, eps, 0 * level, top), z, atol=1e-6), "At level 0 a latent is clean.")
        law = f"At level K = {top} a latent is nothing but noise."
        must(torch.allclose(answer(z, eps, 0 * level + top, top), eps, atol=1e-6), law)
        noisy = answer(z, eps, level, top)
        for b in range(batch):
            for n in range(latents):
                share = float(level[b, n]) / top
                right = (1 - share) * z[b, n] + share * eps[b, n]
                law = f"Latent {n} of sample {b} is at level {level[b, n]} of {top}: {share:.2f} of it is noise."
                must(torch.allclose(noisy[b, n], right, atol=1e-6), law)


def times_per_latent(u: Tensor, num_latents: int, block_size: int, committed: Tensor) -> Tensor:
    """Times (B,N): the drawn u (B,blocks) for each latent of its block, and 1 where committed (B,N) says finished."""
    t = u.repeat_interleave(block_size, dim=1)[:, :num_latents]  # the last block may be cut short
    return t.masked_fill(committed, 1.0)


def _prove_times(answer: Callable) -> None:
    for batch, latents, block in ((1, 1, 1), (1, 3, 1), (2, 4, 2), (2, 7, 3), (3, 10, 4)):
        luck = torch.Generator().manual_seed(latents)
        u = torch.rand(batch, -(-latents // block), generator=luck)
        none, some = torch.zeros(batch, latents, dtype=torch.bool), torch.rand(batch, latents, generator=luck) < 0.5
        t = answer(u, latents, block, none)
        must(tuple(t.shape) == (batch, latents), f"Each of {latents} latents has one time, whatever the blocks: (B,N).")
        for n in range(latents):
            law = f"Latent {n} belongs to block {n // block} and has that block's time."
            must(torch.equal(t[:, n], u[:, n // block]), law)
        masked = answer(u, latents, block, some)
        must((masked[some] == 1).all(), "A committed latent is finished: its time is 1.")
        must(torch.equal(masked[~some], t[~some]), "Latents that are not committed keep the time that was drawn.")


def masked_loss(predicted: Tensor, target: Tensor, asked: Tensor) -> Tensor:
    """The mean squared error over the latents that are asked (B,N bool), whatever stands in the others. Scalar."""
    error = (predicted - target).square().mean(-1)  # (B,N,C) -> (B,N)
    return torch.where(asked, error, 0).sum() / asked.sum().clamp_min(1)


def _prove_loss(answer: Callable) -> None:
    for size, (batch, latents, channels) in enumerate(SHAPES):
        luck = torch.Generator().manual_seed(size)
        z, predicted = torch.randn(2, batch, latents, channels, generator=luck).double()
        asked = torch.rand(batch, latents, generator=luck) < 0.6
        asked[:, 0] = True
        eps = torch.randn(z.shape, generator=torch.Generator().manual_seed(size)).double()  # as the library will draw
        t, luck = torch.full(asked.shape, 0.5).double(), torch.Generator().manual_seed(size)
        library = diffusion_forcing_loss(lambda *_: predicted, z, None, None, asked, generator=luck, t=t)  # noqa: B023
        law = "It is the mean over asked latents: every one of them counts the same, and the others not at all."
        must(torch.allclose(answer(predicted, z - eps, asked), library), law)
        rubbish = predicted.masked_fill(~asked[..., None], torch.nan)
        loss = answer(rubbish, z - eps, asked)
        must(torch.allclose(loss, library), "What stands in a latent that is not asked stays out, even NaN.")
        must(float(answer(predicted, z - eps, ~asked & asked)) == 0, "Where nothing is asked the loss is 0.")


EXERCISES = (
    Exercise(
        "06.1",
        "the share of noise is level / num_steps, and it needs a third axis to meet the channels.",
        noise_by_level,
        _prove_noise,
    ),
    Exercise(
        "06.2",
        "repeat_interleave repeats each block's time along axis 1; cut the last block; masked_fill does the rest.",
        times_per_latent,
        _prove_times,
    ),
    Exercise(
        "06.3",
        "first the mean over channels, then torch.where chooses (0 * NaN is NaN), then divide by how many were asked.",
        masked_loss,
        _prove_loss,
    ),
)
