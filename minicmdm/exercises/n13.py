"""The exercises of notebook 13: what training hides, how many are drawn at a time, kept parts that know no answer."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.editing import encode_kept
from minicmdm.exercises.frame import Exercise, must
from minicmdm.systems.mardm import draw_mask, unmask_counts

COUNTS = ([1], [2], [4], [3, 5], [9, 6, 1], [12, 20, 7], [49, 10, 30, 2])  # latents of each motion of a batch


def choose_masked(valid: Tensor, u: Tensor, luck: Tensor) -> Tensor:
    """Of each motion's latents, valid (B,N), mask a share cos(pi u / 2), u (B,): those of least luck (B,N)."""
    count = (torch.cos(math.pi / 2 * u) * valid.sum(1)).round().clamp_min(1)  # (B,)
    rank = luck.masked_fill(~valid, 2.0).argsort(1).argsort(1)  # (B,N), padding comes last
    return (rank < count[:, None]) & valid


def _prove_choose(answer: Callable) -> None:
    for size, counts in enumerate(COUNTS):
        valid = torch.arange(max(counts)) < torch.tensor(counts)[:, None]  # (B,N)
        for draw in range(4):
            generator = torch.Generator().manual_seed(10 * size + draw)
            u, luck = (torch.rand(shape, generator=generator) for shape in (len(counts), valid.shape))
            masked = answer(valid, u, luck)
            must(masked.shape == valid.shape, "One answer for each latent of each motion: (B,N).")
            must(not (masked & ~valid).any(), "Padding is never masked: the share is one of a motion's own latents.")
            must(masked.any(1).all(), "At least one latent of each motion is masked, or it teaches nothing.")
            for b, count in enumerate(counts):
                share = math.cos(math.pi / 2 * float(u[b]))
                law = f"Motion {b} has {count} latents, and cos(pi u / 2) = {share:.2f} of them are masked, rounded."
                must(int(masked[b].sum()) == max(1, round(share * count)), law)
                hidden, seen = luck[b][masked[b]], luck[b][valid[b] & ~masked[b]]
                must(not len(seen) or hidden.max() < seen.min(), "The masked ones are those with the least luck.")
            library = draw_mask(valid, torch.Generator().manual_seed(10 * size + draw))  # the same u and luck
            must(torch.equal(masked, library), "It is what the library draws.")


def _prove_counts(answer: Callable) -> None:
    for iterations in (2, 3, 5, 10, 18):
        for counts in COUNTS:
            length = torch.tensor(counts)
            found, right = torch.as_tensor(answer(length, iterations)), unmask_counts(length, iterations)
            must(found.shape == right.shape, f"A row for each of {iterations} iterations, a column for each motion.")
            must(torch.equal(found[0], length), "In the first iteration nothing is known: every latent is masked.")
            must(
                (found[-1] == 1).all(), "The last iteration draws one latent: cos(pi / 2) is 0, and at least 1 is left."
            )
            must((found.diff(dim=0) <= 0).all(), "What has left the mask never returns.")
            must(torch.equal(found, right), "In iteration k of K a share cos(pi/2 k / (K-1)) of the latents is masked.")


def _prove_kept(answer: Callable) -> None:
    for size, latents in enumerate((1, 2, 3, 6, 9, 14)):
        luck = torch.Generator().manual_seed(size)
        features = torch.randn(1, 4 * latents, 3, generator=luck).double()
        weights = torch.randn(3, 2, generator=luck).double()

        def encode(x: Tensor) -> Tensor:  # everybody sees everybody; and so that nobody is 0
            whole = x.unflatten(1, (-1, 4)).mean(2) @ weights  # noqa: B023  (1,4N,3) -> (1,N,2)
            return whole + 0.5 * whole.mean(1, keepdim=True) + 3

        for draw in range(4):
            keep = torch.rand(latents, generator=luck) < (0.5 if draw else 1.1)  # first all of them
            z = answer(encode, features, keep)
            must(tuple(z.shape) == (1, latents, 2), "One latent for every 4 frames, kept or not: (1,N,C).")
            must(not z[:, ~keep].any(), "Where nothing is kept there are zeros.")
            changed = features.clone()
            changed[:, ~keep.repeat_interleave(4)] += 1
            again = answer(encode, changed, keep)
            must(torch.equal(again, z), "Change the hidden frames: the kept latents must not move at all.")
            right = encode_kept(encode, features, keep)
            law = "Each run of neighbours that are kept is encoded together, and no two runs: they never met."
            must(torch.allclose(z, right), law)


EXERCISES = (
    Exercise(
        "13.1",
        "how many: cos, times valid.sum(1), rounded, at least 1. Which: luck.masked_fill(~valid, 2) sends padding to "
        "the end, and argsort(1).argsort(1) is each latent's rank.",
        choose_masked,
        _prove_choose,
    ),
    Exercise(
        "13.2",
        "torch.linspace(0, 1, iterations) are the k / (K-1); a column [:, None] of shares times lengths is a table.",
        unmask_counts,
        _prove_counts,
    ),
    Exercise(
        "13.3",
        "walk along `keep` and cut where it changes; encode features[:, 4 * first : 4 * last] of each kept run by "
        "itself and put it into a tensor of zeros.",
        encode_kept,
        _prove_kept,
    ),
)
