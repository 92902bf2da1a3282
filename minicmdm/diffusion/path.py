"""The owner of the time convention: t = 0 is noise, t = 1 is data, and a straight line joins them.

    z_t = t z + (1 - t) eps         v = dz_t/dt = z - eps

Given z_t and t, the three predictions v, z and eps carry the same information:

    z = z_t + (1 - t) v             eps = z_t - t v

The paper writes another path: a DDPM at integer levels k, with k = K noise and k = 0 clean (CMDM Eqs 7-11); its
released code trains the velocity on this one. They are one line at two scales. With s = sqrt(abar) + sqrt(1 - abar),

    x = sqrt(abar) z + sqrt(1 - abar) eps = s z_t         t = sqrt(abar) / s

so the two agree on the signal-to-noise ratio t/(1-t) = sqrt(abar / (1 - abar)). A network asked at t must be shown
x / s, not x: coefficients of one path on latents of the other are the trap (tests/test_sampling.py has its price).

Shapes everywhere: z, eps, v are (B,N,C); t is (B,N), one time per latent, or a plain number.
"""

import math

import torch
from torch import Tensor

DDPM_LEVELS = 1000  # K of the paper's training (CMDM A.3); its sampler visits 50 of them
COSINE_END = math.pi / 2 / 1.008  # the cosine's angle at clean data: an offset of 0.008 keeps the first levels apart


def level_to_time(level: Tensor, num_steps: int, path: str = "flow") -> Tensor:
    """Noise level k in 0..K to flow time t (any shape), so that k = K is t = 0: pure noise.

    "flow" takes equal steps, t = 1 - k/K; "ddpm" the times that match the cosine's abar at k/K.
    ValueError: an unknown path.
    """
    fraction = torch.as_tensor(level) / num_steps
    if path == "flow":
        return 1 - fraction
    if path == "ddpm":
        return alpha_bar_to_time(cosine_alpha_bar(fraction))
    raise ValueError(f"unknown path {path!r}: expected 'flow' or 'ddpm'")


def cosine_alpha_bar(fraction: Tensor) -> Tensor:
    """The cosine schedule's abar at k/K (Nichol and Dhariwal 2021, Eq. 17): 1 at k = 0, and exactly 0 at k = K.

    The paper does not say which abar it means. A sine of the complement, so that K is noise to the last bit."""
    end = torch.full_like(fraction, COSINE_END)
    return (torch.sin((1 - fraction) * end) / torch.sin(end)) ** 2


def cosine_fraction(alpha_bar: Tensor) -> Tensor:
    """The k/K of an abar: `cosine_alpha_bar` undone."""
    return 1 - torch.asin(alpha_bar.sqrt() * math.sin(COSINE_END)) / COSINE_END


def alpha_bar_to_time(alpha_bar: Tensor) -> Tensor:
    """The flow time of the same signal-to-noise ratio, sqrt(abar) / s."""
    return alpha_bar.sqrt() / (alpha_bar.sqrt() + (1 - alpha_bar).sqrt())


def time_to_alpha_bar(t: Tensor) -> Tensor:
    """The abar of the same signal-to-noise ratio: `alpha_bar_to_time` undone."""
    return t**2 / (t**2 + (1 - t) ** 2)


def flow_to_ddpm(z_t: Tensor, t: Tensor | float) -> Tensor:
    """The same latent on the DDPM's path, x = s z_t, where s = 1 / sqrt(t^2 + (1-t)^2)."""
    t = _column(t, z_t)
    return z_t / (t**2 + (1 - t) ** 2).sqrt()


def _column(t: Tensor | float, like: Tensor) -> Tensor:
    t = torch.as_tensor(t, dtype=like.dtype, device=like.device)
    return t.unsqueeze(-1) if t.ndim else t  # (B,N) -> (B,N,1), to broadcast over the channels


def interpolate(z: Tensor, eps: Tensor, t: Tensor | float) -> Tensor:
    """The noisy latent z_t = t z + (1 - t) eps."""
    t = _column(t, z)
    return t * z + (1 - t) * eps


def velocity(z: Tensor, eps: Tensor) -> Tensor:
    """The velocity of the straight path, v = z - eps, the same at every t: the training target."""
    return z - eps


def velocity_to_data(z_t: Tensor, v: Tensor, t: Tensor | float) -> Tensor:
    """Where the path ends if v is right: z = z_t + (1 - t) v."""
    return z_t + (1 - _column(t, z_t)) * v


def velocity_to_noise(z_t: Tensor, v: Tensor, t: Tensor | float) -> Tensor:
    """Where the path began if v is right: eps = z_t - t v."""
    return z_t - _column(t, z_t) * v


def data_to_velocity(z_t: Tensor, z: Tensor, t: Tensor | float) -> Tensor:
    """v from predicted data, (z - z_t) / (1 - t). No answer at t = 1, where z_t is the data itself."""
    return (z - z_t) / (1 - _column(t, z_t))


def noise_to_velocity(z_t: Tensor, eps: Tensor, t: Tensor | float) -> Tensor:
    """v from predicted noise, (z_t - eps) / t. No answer at t = 0, where z_t is the noise itself."""
    return (z_t - eps) / _column(t, z_t)


def euler_step(z_t: Tensor, v: Tensor, t_from: Tensor | float, t_to: Tensor | float) -> Tensor:
    """One step along v. A latent with t_to = t_from is copied bit for bit, whatever v says (even NaN)."""
    step = _column(t_to, z_t) - _column(t_from, z_t)
    return torch.where(step != 0, z_t + step * v, z_t)


def ddim_step(z_t: Tensor, v: Tensor, t_from, t_to, eta: float = 0.0, fresh: Tensor | None = None) -> Tensor:
    """Go to the predicted data and back to t_to, with a part of the noise drawn anew (Song et al. 2021, Eqs 12, 16).

        z_to = t_to z + (1 - t_to) (sqrt(1 - e^2) eps + e fresh)        e^2 = eta^2 (1 - (rho_from / rho_to)^2)

    where rho = t/(1-t) and e is sigma / sqrt(1 - abar_to). eta = 1 is DDPM's ancestral step with the posterior's
    variance (CMDM Alg. 2); eta = 0 is the very Euler step: to DDIM the path is straight. At t_to = 1 no noise is left.
    A latent with t_to = t_from is copied bit for bit. fresh (B,N,C) is N(0, I), and not read when eta = 0.
    """
    if eta == 0:
        return euler_step(z_t, v, t_from, t_to)
    start, end = _column(t_from, z_t), _column(t_to, z_t)
    # A latent that does not move may stand at 0/0 here; its answer is not used.
    ratio = start * (1 - end) / ((1 - start) * end).clamp_min(torch.finfo(z_t.dtype).tiny)
    anew = eta * (1 - ratio**2).clamp_min(0).sqrt()
    eps = (1 - anew**2).sqrt() * velocity_to_noise(z_t, v, t_from) + anew * fresh
    return torch.where(start != end, end * velocity_to_data(z_t, v, t_from) + (1 - end) * eps, z_t)
