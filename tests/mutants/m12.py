"""Wrong answers to the exercises of notebook 12."""

import math

import torch

from minicmdm.exercises.n12 import window_of_call
from minicmdm.systems.flood import to_velocity, triangle


def clock(moment, latents, gap):
    """Clocks that start `gap` apart."""
    return (moment - gap * torch.arange(latents, dtype=torch.float64)).clamp(0, 1)


def window(call, latents, steps, overlap, rounded=math.floor, one=1, bounded=True):
    s = call / steps
    first, end = rounded((s - 1) * overlap) + one, rounded(s * overlap) + one
    return (max(0, first), min(latents, end)) if bounded else (first, end)


def column(t):
    return t.unsqueeze(-1)


MUTANTS = {
    "12.1": [
        lambda s, N, n_s: s - torch.arange(N) / n_s,  # not clamped
        lambda s, N, n_s: (s - torch.arange(N) / n_s).clamp_min(0),  # only below
        lambda s, N, n_s: clock(s, N, n_s),  # n_s apart instead of 1 / n_s
        lambda s, N, n_s: clock(s, N, 1),  # one after the other, whatever n_s
        lambda s, N, n_s: clock(s - 1 / n_s, N, 1 / n_s),  # latent 0 waits, too
        lambda s, N, n_s: clock(s / n_s, N, 1 / n_s),  # too slow
        lambda s, N, n_s: clock(s, N, 1 / (n_s + 1)),  # n_s + 1 in flight
        lambda s, N, n_s: triangle(s, N, n_s).flip(0),  # the last one first
        lambda s, N, n_s: 1 - triangle(s, N, n_s),  # beta, the noise
        lambda s, N, n_s: triangle(s, N, n_s)[: N - 1] if N > 1 else triangle(s, N, n_s),
        lambda s, N, n_s: (triangle(s, N, n_s) * n_s).floor() / n_s,  # in jumps
    ],
    "12.2": [
        lambda *plan: window(*plan, rounded=math.ceil, one=0),  # Eqs 23-24 as printed
        lambda *plan: window(*plan, rounded=int),  # the released code: truncates towards 0
        lambda *plan: window(
            *plan, rounded=lambda x: math.floor(x + 1e-9), bounded=False
        ),  # latents that are not there
        lambda *plan: window(*plan, rounded=lambda x: math.floor(x + 1e-9), one=0),  # floors, and one too few
        lambda *plan: window(*plan, rounded=lambda x: math.floor(x + 1e-9), one=2),
        lambda *plan: (window_of_call(*plan)[0], min(plan[1], window_of_call(*plan)[0] + plan[3])),  # n_s at once
        lambda *plan: (0, window_of_call(*plan)[1]),  # the past is denoised again and again
        lambda *plan: (window_of_call(*plan)[0], plan[1]),  # all that waits, too
        lambda *plan: (window_of_call(*plan)[0], window_of_call(*plan)[1] - 1),  # the last latent, not where it ends
    ],
    "12.3": [
        lambda p, target, z_t, t: p,  # every prediction taken for a velocity
        lambda p, target, z_t, t: (
            (z_t - p) / (column(t) + 0.1) if target == "eps" else to_velocity(p, target, z_t, t)
        ),  # the released code's divisor
        lambda p, target, z_t, t: (z_t - p) / column(t) if target == "eps" else to_velocity(p, target, z_t, t),  # 0/0
        lambda p, target, z_t, t: (p - z_t) / (1 - column(t)) if target == "x0" else to_velocity(p, target, z_t, t),
        lambda p, target, z_t, t: (
            (p - z_t) / (1 - column(t)).clamp_min(1e-6) if target == "x0" else to_velocity(p, target, z_t, t)
        ),  # a finished latent is thrown about
        lambda p, target, z_t, t: (
            (p - z_t) / column(t).clamp_min(1e-3) if target == "x0" else to_velocity(p, target, z_t, t)
        ),  # the divisors exchanged
        lambda p, target, z_t, t: (
            -to_velocity(p, target, z_t, t) if target == "eps" else to_velocity(p, target, z_t, t)
        ),
        lambda p, target, z_t, t: to_velocity(p, target, z_t, t.mean(1, keepdim=True).expand_as(t)),  # one time for all
        lambda p, target, z_t, t: to_velocity(p, "v" if target == "x0" else target, z_t, t),
    ],
}
