"""Wrong answers to the exercises of notebook 13."""

import math

import torch

from minicmdm.editing import encode_kept
from minicmdm.systems.mardm import unmask_counts


def masked(valid, u, luck, curve=lambda u: torch.cos(math.pi / 2 * u), least=1, of=None, order=None, everywhere=False):
    total = valid.sum(1) if of is None else of(valid)
    count = (curve(u) * total).round().clamp_min(least)
    rank = luck.masked_fill(~valid, 2.0) if order is None else order(luck, valid)
    chosen = rank.argsort(1).argsort(1) < count[:, None]
    return chosen if everywhere else chosen & valid


def shares(length, iterations, share, least=1):
    at = torch.linspace(0, 1, iterations, dtype=torch.float64)
    return (share(at)[:, None] * length).round().clamp_min(least).long()


def cosine(at):
    return torch.cos(math.pi / 2 * at)


def cut(encode, features, keep):
    """The released way: encode all, then hide."""
    return encode(features) * keep[None, :, None]


def blanked(encode, features, keep):
    """Hidden frames are set to 0, but they are still looked at, and so are the other kept runs."""
    return encode(features * keep.repeat_interleave(4)[None, :, None]) * keep[None, :, None]


def joined(encode, features, keep):
    """Kept runs are pushed together, as if they had met."""
    z = torch.zeros(1, len(keep), 2, dtype=features.dtype)
    if keep.any():
        z[:, keep] = encode(features[:, keep.repeat_interleave(4)])
    return z


def one_by_one(encode, features, keep):
    """Each latent by itself: it knows neither what is hidden nor its own neighbours."""
    pieces = [encode(features[:, 4 * n : 4 * n + 4]) * keep[n] for n in range(len(keep))]
    return torch.cat(pieces, 1)


MUTANTS = {
    "13.1": [
        lambda valid, u, luck: masked(valid, u, luck, of=lambda v: v.shape[1]),  # the release: counts the padding
        lambda valid, u, luck: masked(valid, u, luck, least=0),  # a motion without a mask
        lambda valid, u, luck: masked(valid, u, luck, curve=lambda u: u),  # half of them on average
        lambda valid, u, luck: masked(valid, u, luck, curve=lambda u: torch.sin(math.pi / 2 * u)),
        lambda valid, u, luck: masked(valid, u, luck, order=lambda luck, v: luck),  # padding stands in the way
        lambda valid, u, luck: masked(valid, u, luck, order=lambda luck, v: -luck.masked_fill(~v, -2.0)),  # most luck
        lambda valid, u, luck: masked(valid, u, luck, everywhere=True, of=lambda v: v.shape[1]),  # masks padding
        lambda valid, u, luck: (luck < torch.cos(math.pi / 2 * u)[:, None]) & valid,  # a coin for each
        lambda valid, u, luck: masked(valid, u[:1].expand_as(u), luck),  # one share for the whole batch
    ],
    "13.2": [
        lambda length, K: shares(length, K, cosine, least=0),  # the last iteration draws nobody
        lambda length, K: shares(length, K, lambda at: 1 - at),  # a straight line
        lambda length, K: shares(length, K, lambda at: torch.cos(math.pi / 2 * at * (K - 1) / K)),  # never gets to 0
        lambda length, K: shares(length, K + 1, cosine)[1:],  # what is masked after the iteration, not in it
        lambda length, K: shares(length, K, cosine).flip(0),
        lambda length, K: shares(length.max().expand_as(length), K, cosine),  # the batch's longest for all
        lambda length, K: -unmask_counts(length, K).diff(dim=0, append=length[None] * 0),  # how many are revealed
        lambda length, K: unmask_counts(length, K).T,
    ],
    "13.3": [
        cut,
        blanked,
        joined,
        one_by_one,
        lambda encode, features, keep: encode_kept(encode, features, keep | True),  # hides nothing
        lambda encode, features, keep: encode_kept(encode, features, ~keep),  # upside down
        lambda encode, features, keep: encode_kept(encode, features, keep)[:, keep],  # latents without their places
    ],
}
