"""One sampler for every scheduling matrix, four step rules, and classifier-free guidance (CMDM Alg. 2).

The matrix says all there is to say about order: row m gives each latent's noise level, and going to row
m+1 is one call of the denoiser and one step of the latents whose level changes. Full-sequence,
autoregressive and frame-wise (FSS) sampling are the same loop over different matrices.

The solver says how far a step trusts the denoiser:

    "euler"  straight on along the velocity. The release's, and the default
    "heun"   along the mean of the velocities at both ends of the step. Two calls a row; its error falls with the square
             of the step
    "ddim"   to the predicted data and back. With eta = 0 that is the Euler step again; with more, some noise is new
    "ddpm"   the same with eta = 1: the ancestral step of CMDM Alg. 2

and the path says which times the levels stand for: "flow" t = 1 - k/K, "ddpm" the paper's cosine. Any solver goes with
any path, as the state is always z_t of diffusion/path.py: two paths that match in signal-to-noise are one.

CMDM's Alg. 2, read literally, would also step latents that wait (level K) or are finished (level 0). The released
code leaves those alone, and so do we, whatever the solver.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from minicmdm.diffusion.path import (
    DDPM_LEVELS,
    cosine_alpha_bar,
    cosine_fraction,
    ddim_step,
    euler_step,
    flow_to_ddpm,
    level_to_time,
    time_to_alpha_bar,
    velocity_to_data,
)
from minicmdm.diffusion.schedules import check_matrix

Denoise = Callable[[Tensor, Tensor], Tensor]  # (z_t (B,N,C), t (B,N)) -> velocity (B,N,C)
Luck = torch.Generator | Sequence[torch.Generator]  # one for the batch, or one for each of its samples
SOLVERS = ("euler", "heun", "ddpm", "ddim")
NOISIEST = (
    0.98  # of K, one of 50 steps from pure noise: the noisiest level at which a prediction of noise is turned into data
)


@dataclass
class SampleStep:
    """A moment of sampling, for films and streams: the state after `row` steps."""

    row: int  # 0 is the noise before any step
    levels: np.ndarray  # (N,) noise levels
    z: Tensor  # (B,N,C)
    t: Tensor  # (B,N) flow times of z
    clean: Tensor | None  # (B,N,C) where the call before it thought each latent would end (a latent that still
    # waited was not asked and keeps its noise here); None in row 0


def sample_steps(
    denoise: Denoise,
    matrix: np.ndarray,
    noise: Tensor,
    prefix: Tensor | None = None,
    *,
    solver: str = "euler",
    path: str = "flow",
    eta: float = 0.0,
    generator: Luck | None = None,
) -> Iterator[SampleStep]:
    """Yield the state at every row of the matrix (M,N), starting from noise (B,N,C).

    Latents that wait for their turn are hidden: each call sees the latents up to the last one that has started, and
    nothing after it. Under a causal mask that changes no number and saves half of the work. (The trapezoid starts at
    both ends, so what waits between them is seen, as pure noise.)
    A prefix (B,P,C) of finished latents is put in front: it is at level 0 throughout, never moves, and is
    part of every z that is yielded. For a model with blocks, P should be a multiple of the block size.
    solver, path: see the top of the file. eta in [0,1] is read by "ddim" alone, and is 1 for "ddpm". Whoever draws new
    noise needs the generator: one, or one for each sample, so that none depends on the others.
    ValueError: the matrix is not a schedule, its columns are not the noise's latents, an unknown solver or path, an eta
    outside [0,1] or for a solver that has none, or new noise and no generator.
    """
    matrix = check_matrix(matrix)
    eta = _check_solver(solver, eta, generator)
    num_steps = int(matrix[0, 0])  # K
    if noise.ndim != 3 or noise.shape[1] != matrix.shape[1]:
        raise ValueError(
            f"the matrix schedules {matrix.shape[1]} latents, so noise must be (batch, {matrix.shape[1]}, "
            f"channels), got {tuple(noise.shape)}"
        )
    z = noise
    if prefix is not None:
        z = torch.cat([prefix.to(noise), noise], dim=1)  # (B,P+N,C)
        matrix = np.concatenate([np.zeros((len(matrix), prefix.shape[1]), np.int64), matrix], axis=1)
    levels = torch.from_numpy(matrix).to(z.device)
    times = level_to_time(levels.to(z.dtype), num_steps, path).unsqueeze(1).expand(-1, len(z), -1)  # (M,B,N)
    clean = None
    yield SampleStep(0, matrix[0], z, times[0], clean)
    for row in range(1, len(matrix)):
        before, after = times[row - 1], times[row]
        if (matrix[row] != matrix[row - 1]).any():  # a row in which nothing moves costs nothing
            # Right of the last latent that has started all wait. (One that is finished may stand right of all movers.)
            seen = int(np.flatnonzero(matrix[row] < num_steps)[-1]) + 1
            v = _velocity(denoise, z, before, seen)
            clean = velocity_to_data(z, v, before)
            if solver == "heun":
                v = (v + _velocity(denoise, euler_step(z, v, before, after), after, seen)) / 2
            fresh = _fresh_noise(z, generator) if eta else None
            z = ddim_step(z, v, before, after, eta, fresh)  # Euler's, when eta is 0
        yield SampleStep(row, matrix[row], z, after, clean)


def _velocity(denoise: Denoise, z: Tensor, t: Tensor, seen: int) -> Tensor:
    v = denoise(z[:, :seen], t[:, :seen])  # (B,seen,C)
    return torch.cat([v, torch.zeros_like(z[:, seen:])], dim=1)  # (B,N,C)


def _fresh_noise(z: Tensor, generator: Luck) -> Tensor:
    if isinstance(generator, torch.Generator):
        return torch.randn(z.shape, generator=generator, dtype=z.dtype, device=generator.device).to(z.device)
    each = [torch.randn(z.shape[1:], generator=g, dtype=z.dtype, device=g.device) for g in generator]
    return torch.stack(each).to(z.device)


def _check_solver(solver: str, eta: float, generator: Luck | None) -> float:
    if solver not in SOLVERS:
        raise ValueError(f"unknown solver {solver!r}: expected one of {', '.join(SOLVERS)}")
    if not 0 <= eta <= 1:
        raise ValueError(f"eta is the share of new noise, between 0 and 1, got {eta!r}")
    if eta and solver != "ddim":
        raise ValueError(f"eta belongs to the solver ddim, {solver} has none (ddpm is ddim with eta = 1)")
    eta = 1.0 if solver == "ddpm" else float(eta)
    if eta and generator is None:
        raise ValueError(f"the solver {solver} draws new noise at every step: give it a generator")
    return eta


@torch.no_grad()
def sample(
    denoise: Denoise,
    matrix: np.ndarray,
    noise: Tensor,
    prefix: Tensor | None = None,
    *,
    solver: str = "euler",
    path: str = "flow",
    eta: float = 0.0,
    generator: Luck | None = None,
) -> Tensor:
    """Run the matrix (M,N) to its end: noise (B,N,C) -> clean latents (B,N,C), or (B,P+N,C) with a prefix.

    The arguments are those of `sample_steps`.
    """
    steps = sample_steps(denoise, matrix, noise, prefix, solver=solver, path=path, eta=eta, generator=generator)
    for step in steps:  # noqa: B007  the last step is the answer
        pass
    return step.z


def from_noise_prediction(predict: Denoise) -> Denoise:
    """Turn a model of the paper's objective into a denoiser: (x, 1 - k/1000) -> eps becomes (z_t, t) -> velocity.

    `predict` is bound to its text (`guided` will do: guiding eps and guiding v are the same) and was trained with
    `diffusion_forcing_loss(path="ddpm")`. It works with every solver; path="ddpm" visits the levels it knows.
    At pure noise a prediction of eps says nothing of the data: z = (x - sqrt(1 - abar) eps) / sqrt(abar) is 0/0 there,
    and near it any error of eps is blown up. So noisier levels are read as if they were NOISIEST K, where 3 % of x is
    signal. Some of that error stays with "euler", "heun" and "ddim"; "ddpm" draws new noise and forgets it.
    """

    def denoise(z_t: Tensor, t: Tensor) -> Tensor:
        level = (DDPM_LEVELS * cosine_fraction(time_to_alpha_bar(t))).round().clamp(0, NOISIEST * DDPM_LEVELS)  # (B,N)
        alpha_bar = cosine_alpha_bar(level / DDPM_LEVELS).unsqueeze(-1)  # (B,N,1)
        x = flow_to_ddpm(z_t, t)
        eps = predict(x, 1 - level / DDPM_LEVELS)
        return (x - (1 - alpha_bar).sqrt() * eps) / alpha_bar.sqrt() - eps

    return denoise


def guided(
    model,
    words: Tensor,
    mask: Tensor,
    null_words: Tensor,
    null_mask: Tensor,
    guidance_scale: float,
    valid: Tensor | None = None,
    clock: Tensor | None = None,
) -> Denoise:
    """Bind the text to a model: a denoiser that returns v = v_null + s (v_text - v_null).

    words (B,S,E) and mask (B,N,S) are the sentence's, null_words (B,S',E) and null_mask (B,N,S') those of
    "". valid (B,N) and clock (B,N,2) are the model's own. Both branches run in one batch of 2B. A scale of 1 is the
    plain conditional model, and 0 the unconditional one; each runs one branch. ValueError: a scale that is not a
    finite number.
    """
    if not np.isfinite(guidance_scale):
        raise ValueError(f"guidance_scale must be a finite number, got {guidance_scale!r}")

    def one(words: Tensor, mask: Tensor, times: int = 1) -> Denoise:
        more = [None if x is None else torch.cat([x] * times) for x in (valid, clock)]

        def denoise(z_t: Tensor, t: Tensor) -> Tensor:
            seen = z_t.shape[1]  # a call may hide the latents at the end
            return model(z_t, t, words, mask[:, :seen], *(None if x is None else x[:, :seen] for x in more))

        return denoise

    if guidance_scale == 1:
        return one(words, mask)
    if guidance_scale == 0:
        return one(null_words, null_mask)

    # Pad the shorter sentence with words nobody sees, so that both fit in one batch.
    length = max(words.shape[1], null_words.shape[1])
    both_words = torch.cat([_pad(words, length, axis=1), _pad(null_words, length, axis=1)])  # (2B,S,E)
    both_masks = torch.cat([_pad(mask, length, axis=2), _pad(null_mask, length, axis=2)])  # (2B,N,S)
    both = one(both_words, both_masks, times=2)

    def denoise(z_t: Tensor, t: Tensor) -> Tensor:
        v_text, v_null = both(torch.cat([z_t, z_t]), torch.cat([t, t])).chunk(2)  # 2 x (B,N,C)
        return v_null + guidance_scale * (v_text - v_null)

    return denoise


def _pad(x: Tensor, length: int, axis: int) -> Tensor:
    shape = list(x.shape)
    shape[axis] = length - x.shape[axis]
    return torch.cat([x, x.new_zeros(shape)], dim=axis)
