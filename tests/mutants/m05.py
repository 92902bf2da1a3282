"""Wrong answers to the exercises of notebook 05."""

import torch


def posterior(x, z, abar, abar_to, kept=None, variance=None):
    alpha = abar / abar_to
    kept = alpha**0.5 if kept is None else kept
    mean = (kept * (1 - abar_to) * x + abar_to**0.5 * (1 - alpha) * z) / (1 - abar)
    return mean, (1 - abar_to) * (1 - alpha) / (1 - abar) if variance is None else variance


def with_nan(z_t, v, t, t_to):
    return z_t + (t_to - t)[..., None] * v


MUTANTS = {
    "05.1": [
        lambda z, eps, t: (1 - t)[..., None] * z + t[..., None] * eps,  # the other clock: t = 1 is noise
        lambda z, eps, t: t.mean() * z + (1 - t.mean()) * eps,  # one time for all
        lambda z, eps, t: t[..., None] * z + eps,  # noise that never fades
        lambda z, eps, t: t[..., None] * z + (1 - t[..., None] ** 2).sqrt() * eps,  # a circle, as in DDPM
        lambda z, eps, t: t * z + (1 - t) * eps,  # times along the wrong axis
        lambda z, eps, t: t[:, :1, None] * z + (1 - t[:, :1, None]) * eps,  # the first latent's time for all
    ],
    "05.2": [
        lambda z_t, v, t: z_t + t[..., None] * v,  # the way already gone
        lambda z_t, v, t: z_t - t[..., None] * v,  # the noise
        lambda z_t, v, t: z_t - (1 - t[..., None]) * v,  # the wrong sign
        lambda z_t, v, t: z_t + v,
        lambda z_t, v, t: (z_t + v) / (2 - t[..., None]),
    ],
    "05.3": [
        lambda x, z, a, b: posterior(x, z, a, b, kept=a**0.5),  # MARDM Eq. 2: abar for alpha
        lambda x, z, a, b: posterior(x, z, a, b, variance=1 - a),  # MARDM Eq. 2: all the noise
        lambda x, z, a, b: posterior(x, z, a, b, variance=1 - a / b),  # beta: right on average over the data only
        lambda x, z, a, b: (b**0.5 * z, 1 - b),  # forgets x, and draws all noise anew
        lambda x, z, a, b: (posterior(x, z, a, b)[0], posterior(x, z, a, b)[1] ** 0.5),  # a deviation, no variance
        lambda x, z, a, b: posterior(x, z, b, a),
        lambda x, z, a, b: (x - (1 - a / b) ** 0.5 / (1 - a) ** 0.5 * (x - a**0.5 * z) / (1 - a) ** 0.5, 0.0),
    ],
    "05.4": [
        with_nan,  # right, until a latent that waits has no velocity
        lambda z_t, v, t, t_to: z_t + torch.nan_to_num(v),  # the whole way at once
        lambda z_t, v, t, t_to: with_nan(z_t, torch.nan_to_num(v), t_to, t),  # backwards
        lambda z_t, v, t, t_to: with_nan(z_t, torch.nan_to_num(v), t, t_to.mean()),
        lambda z_t, v, t, t_to: torch.nan_to_num(with_nan(z_t, v, t, t_to)),  # a waiting latent is lost
        lambda z_t, v, t, t_to: z_t + (t_to - t).abs()[..., None] * torch.nan_to_num(v),
    ],
}
