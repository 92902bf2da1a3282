"""Wrong answers to the exercises of notebook 06."""

import torch

from minicmdm.exercises.n06 import masked_loss, times_per_latent


def share(level, steps):
    return (level / steps)[..., None]


MUTANTS = {
    "06.1": [
        lambda z, eps, k, K: share(k, K) * z + (1 - share(k, K)) * eps,  # K is clean: the other clock
        lambda z, eps, k, K: (1 - k.double().mean() / K) * z + k.double().mean() / K * eps,  # one level for all
        lambda z, eps, k, K: z + share(k, K) * (eps - z).mean(-1, keepdim=True),  # one noise for all channels
        lambda z, eps, k, K: (1 - share(k, K)) ** 0.5 * z + share(k, K) ** 0.5 * eps,  # keeps the variance: DDPM's path
        lambda z, eps, k, K: (1 - share(k, K + 1)) * z + share(k, K + 1) * eps,  # never quite noise
    ],
    "06.2": [
        lambda u, N, b, done: u.repeat(1, b)[:, :N].masked_fill(done, 1.0),  # latents far apart share a time
        lambda u, N, b, done: u.repeat_interleave(b, 1).masked_fill(done, 1.0),  # the last block overhangs
        lambda u, N, b, done: times_per_latent(u, N, b, done).masked_fill(done, 0.0),  # finished is told as noise
        lambda u, N, b, done: times_per_latent(u, N, b, ~done),  # the mask upside down
        lambda u, N, b, done: times_per_latent(u[:1], N, b, done),  # one draw for the whole batch
        lambda u, N, b, done: torch.where(done, 1.0, u[:, :1]),  # one level for all: no forcing at all
    ],
    "06.3": [
        lambda p, v, asked: (p - v).square().mean(),  # everything counts
        lambda p, v, asked: ((p - v).square().mean(-1) * asked).mean(),  # divided by all latents, and NaN gets through
        lambda p, v, asked: torch.where(asked, (p - v).square().mean(-1), 0).mean(),
        lambda p, v, asked: torch.where(asked, (p - v).square().sum(-1), 0).sum() / asked.sum().clamp_min(1),
        lambda p, v, asked: (p - v).square().mean(-1)[asked].mean(),  # nothing asked: 0/0
        lambda p, v, asked: torch.where(asked, (p - v).abs().mean(-1), 0).sum() / asked.sum().clamp_min(1),
        lambda p, v, asked: masked_loss(p, v, asked) * asked.any(-1).sum(),  # a sum over samples
    ],
}
