"""The owner of the time convention: t = 0 is noise, t = 1 is data, and a straight line joins them.

    z_t = t z + (1 - t) eps         v = dz_t/dt = z - eps

Given z_t and t, the three predictions v, z and eps carry the same information:

    z = z_t + (1 - t) v             eps = z_t - t v

The paper writes a DDPM that predicts eps at integer levels k, with k = K noise and k = 0 clean (CMDM Eqs
7-11); its released code trains the velocity on this path. `level_to_time` is the bridge between the clocks.

Shapes everywhere: z, eps, v are (B,N,C); t is (B,N), one time per latent, or a plain number.
"""

import torch
from torch import Tensor


def level_to_time(level: Tensor, num_steps: int) -> Tensor:
    """Noise level k in 0..K to flow time t = 1 - k/K (any shape), so that k = K is t = 0: pure noise."""
    return 1 - torch.as_tensor(level) / num_steps


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
