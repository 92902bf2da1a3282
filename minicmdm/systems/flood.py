"""FloodDiffusion: latents come in as a triangle of noise levels, and all in flight see each other.

Every latent k has a clock that starts k / n_s after the first one's (Eqs 19-20, in our convention t = 0 is noise):

    t^k(s) = clip(s - k / n_s, 0, 1)        alpha = t, beta = 1 - t, each a vector over the latents

so at any moment s there are finished latents (t = 1), at most n_s in flight, and latents that wait (t = 0). What it
adds to CMDM, whose VAE, transformer, words and sampler it shares here, is its training: only these triangles are shown,
the past is clean, the future hidden, and the loss asks for the latents in flight. Attention is bidirectional: the true
velocity in the window depends on all of the window (Theorem 3.8), and a causal mask would have to guess (gaussian.py).
Each latent sees the words of the prompt that is active at its time, as everywhere in this library.

Triangle and FSS are one schedule: N = K steps a latent and n_s = K / L (schedules.py). The system "window" (ours) lets
finished latents look back only, and learns from all triangles of a clip at once (diffusion/tiles.py).

Where the paper misprints or its code errs, this file does the right thing and tests/test_errata_flows.py shows both:

* Eqs 23-24 round the window up. Then each latent misses its first step and makes one when it is clean; what moves is
  [floor((s-1) n_s) + 1, floor(s n_s) + 1). The code truncates towards 0, so latent 0 leaves two steps of ten too soon.
* Eq. 22 lets s run to 1 + N / n_s. The last latent is clean at 1 + (N-1) / n_s. The code trains up to N / n_s only, so
  a window that no new latent enters was never seen.
* Eq. 61's x needs a plus sign: eps = (x - alpha z) / beta. Eq. 8 is 0/0 for finished latents and Eq. 17 for those that
  begin; `conditional_velocity` is neither.
* To turn predicted noise into a velocity the code divides by alpha + ds instead of alpha: too much variance in the end.
"""

import torch
from torch import Tensor

from minicmdm.diffusion.path import data_to_velocity, noise_to_velocity
from minicmdm.diffusion.tiles import TICKS
from minicmdm.models.dit import TARGETS

NEAR_NOISE = 0.02  # of t: below it predicted noise says nothing of the data


def triangle(moment: float, num_latents: int, overlap: int) -> Tensor:
    """Flow times t^k (N,) float64 at the moment s = `moment`; alpha is t and beta 1 - t (FloodDiffusion Eqs 19-20)."""
    place = torch.arange(num_latents, dtype=torch.float64)
    return (moment - place / overlap).clamp(0, 1)


def active_window(moment: float, num_latents: int, overlap: int) -> tuple[int, int]:
    """[m, n): the latents that an Euler step from s = `moment` moves (Eqs 23-24 with floors, as steps go forward)."""
    s = torch.tensor(moment * overlap, dtype=torch.float64)
    # A moment is a multiple of a step and n_s of them a whole number, but not in floating point.
    s = torch.where((s - s.round()).abs() < 1e-9, s.round(), s).floor()
    return max(0, int(s) - overlap + 1), min(num_latents, int(s) + 1)


def last_moment(num_latents: int, overlap: int) -> float:
    """When the last latent is clean: 1 + (N - 1) / n_s (Eq. 22 waits for one more)."""
    return 1 + (num_latents - 1) / overlap


def conditional_velocity(z: Tensor, eps: Tensor, alpha_rate: Tensor, beta_rate: Tensor) -> Tensor:
    """The velocity of z_t = alpha z + beta eps given z: alpha' z + beta' eps (N,C), rates (N,) (Prop. 3.2).

    Eq. 8 writes it in x and divides by beta, which is 0 where a latent is finished; this is the same and never is 0/0.
    """
    return alpha_rate.unsqueeze(-1) * z + beta_rate.unsqueeze(-1) * eps


def conditional_score(z_t: Tensor, z: Tensor, alpha: Tensor, beta: Tensor) -> Tensor:
    """The score of N(alpha z, beta^2) at z_t: -(z_t - alpha z) / beta^2, and 0 for finished latents (Prop. 3.2)."""
    alpha, beta = alpha.unsqueeze(-1), beta.unsqueeze(-1)  # (N,) -> (N,1)
    return torch.where(beta > 0, -(z_t - alpha * z) / beta.clamp_min(1e-12) ** 2, 0.0)


def draw_triangle(
    valid: Tensor, overlap: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """A moment for each sample of a batch, and what it shows: times (B,N), finished and visible latents (B,N) bool.

    valid (B,N). The moment is uniform over the life of the sample's own triangle, down to its last latent, and lies on
    a grid of TICKS a latent: in whole numbers no latent is moved or missed by rounding.
    """
    device = generator.device if generator is not None else valid.device
    luck = torch.rand(len(valid), generator=generator, device=device).to(valid.device)
    ticks = (luck * TICKS * (overlap + valid.sum(1) - 1)).long()  # (B,), TICKS * n_s of them make a unit of time
    since = ticks[:, None] - TICKS * torch.arange(valid.shape[1], device=valid.device)  # (B,N)
    t = (since.to(torch.float32) / (TICKS * overlap)).clamp(0, 1)
    return t, valid & (since >= TICKS * overlap), valid & (since >= 0)


def to_velocity(predicted: Tensor, target: str, z_t: Tensor, t: Tensor) -> Tensor:
    """The velocity (B,N,C) that a prediction of v, x0 or eps at z_t, t (B,N) stands for. ValueError: another target.

    v = (x0 - z_t) / (1 - t) = (z_t - eps) / t. Where a latent begins, eps is all of z_t and tells nothing of v: times
    below NEAR_NOISE are read as if they were NEAR_NOISE.
    """
    if target == "v":
        return predicted
    if target == "x0":
        return torch.where((t < 1).unsqueeze(-1), data_to_velocity(z_t, predicted, t.clamp_max(1 - 1e-6)), 0.0)
    if target == "eps":
        return noise_to_velocity(z_t, predicted, t.clamp_min(NEAR_NOISE))
    raise ValueError(f"unknown target {target!r}: expected one of {', '.join(TARGETS)}")
