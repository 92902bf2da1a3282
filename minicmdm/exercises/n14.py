"""The exercises of notebook 14: residual codes, one straight gradient, a mask in three readings."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.exercises.frame import Exercise, must
from minicmdm.systems.cdamd import READINGS, ResidualQuantizer, dual_mask

SHAPES = [(1, 1, 1, 1), (2, 1, 3, 1), (3, 2, 2, 1), (3, 2, 4, 2)]  # vectors, levels, codes, channels


def _cases(seed: int) -> list[tuple[Tensor, Tensor]]:
    """Vectors (M,C) and codebooks (Q,V,C), each level finer than the one before."""
    luck = torch.Generator().manual_seed(seed)
    random = [torch.randint(3, 9, (4,), generator=luck).tolist() for _ in range(5)]
    cases = []
    for count, levels, codes, channels in SHAPES + sorted(random):
        book = torch.randn(levels, codes, channels, generator=luck, dtype=torch.float64)
        z = 1.5 * torch.randn(count, channels, generator=luck, dtype=torch.float64)
        cases.append((z, book * 0.6 ** torch.arange(levels, dtype=torch.float64)[:, None, None]))
    return cases


def _library(codebook: Tensor) -> ResidualQuantizer:
    quantizer = ResidualQuantizer(*codebook.shape).to(codebook.dtype)
    quantizer.codebook.copy_(codebook.detach())
    return quantizer


def residual_codes(z: Tensor, codebook: Tensor) -> tuple[Tensor, Tensor]:
    """Each level's nearest code (M,Q) for vectors z (M,C) and codebooks (Q,V,C), and the sum of these codes (M,C)."""
    left, named = z, []
    for book in codebook:
        index = (left[:, None] - book).square().sum(-1).argmin(-1)  # (M,V) -> (M,)
        left = left - book[index]  # what the next level is to name
        named.append(index)
    return torch.stack(named, dim=-1), z - left


def _prove_codes(answer: Callable) -> None:
    for z, codebook in _cases(1):
        before = z.clone()
        codes, total = answer(z, codebook)
        must(torch.equal(z, before), "z is somebody else's: `left = left - ...` makes a new tensor, `left -= ...` not.")
        must(codes.shape == (len(z), len(codebook)), "One code for each vector and level: (M,Q).")
        must(total.shape == z.shape, "The sum of the codes is a vector for each vector: (M,C).")
        right = _library(codebook).codes(z)
        must(torch.equal(codes[:, 0], right[:, 0]), "Level 0 names the code that is nearest to z.")
        must(torch.equal(codes, right), "Each next level names what is nearest to that which is left, in its own book.")
        must(torch.allclose(total, _library(codebook).decode(right)), "A vector is decoded as the sum over all levels.")


def straight_through(z: Tensor, codebook: Tensor) -> Tensor:
    """The sum of the codes of z (M,C), whose gradient goes to z as if nothing had happened, and to no codebook."""
    found = residual_codes(z, codebook)[1].detach()
    return z + (found - z).detach()


def _prove_straight(answer: Callable) -> None:
    for z, codebook in _cases(2):
        z.requires_grad_()
        codebook.requires_grad_()
        out = answer(z, codebook)
        right = _library(codebook)
        must(torch.allclose(out, right.decode(right.codes(z.detach()))), "Its value is the sum of the codes, not z.")
        must(out.requires_grad, "Something must lead back to z: argmin has no gradient of its own.")
        pull = torch.randn(z.shape, generator=torch.Generator().manual_seed(3), dtype=z.dtype)
        to_z, to_book = torch.autograd.grad(out, [z, codebook], pull, allow_unused=True)
        must(to_z is not None, "Something must lead back to z: argmin has no gradient of its own.")
        must(
            torch.allclose(to_z, pull),
            "Whatever the number of levels, z gets the gradient of the sum once: no more and no less.",
        )
        must(to_book is None or not to_book.any(), "Codebooks are running means: no gradient reaches them.")


def _prove_mask(answer: Callable) -> None:
    luck = torch.Generator().manual_seed(4)
    shapes = [(1, 1), (1, 2), (1, 3), (2, 4), *((3, int(torch.randint(5, 12, (), generator=luck))) for _ in range(4))]
    for shape in shapes:
        for _ in range(4):
            known = torch.rand(shape, generator=luck) < 0.5
            for reading in READINGS:
                got, right = answer(known, reading), dual_mask(known, reading)
                must(got.shape == right.shape, "One matrix for each sample: (B,N,N), rows look at columns.")
                for row, what in ((known, "known"), (~known, "to be made")):
                    same = (got.bool() == right) | ~row.unsqueeze(2)
                    must(same.all(), f'"{reading}", the rows that are {what}: {_LAWS[reading, what]}')


_LAWS = {
    ("trained", "known"): "they see all that is known, before and after them, and nothing else.",
    ("trained", "to be made"): "they look back, at anything, themselves included, and never ahead.",
    ("run", "known"): "here it makes no difference who is known: all look back.",
    ("run", "to be made"): "they look back, themselves included, and at nothing that comes later, known or not.",
    ("meant", "known"): "they see all that is known, before and after them, and nothing else.",
    ("meant", "to be made"): "they look back, and at all that is known, even ahead.",
}

EXERCISES = (
    Exercise(
        "14.1",
        "keep what is left, z at first. A level finds the nearest row of its book to what is left, and takes it off. "
        "What all levels took off is z minus what is left in the end.",
        residual_codes,
        _prove_codes,
    ),
    Exercise(
        "14.2",
        "let the levels work without any gradient, as in 14.1, and build the one bridge at the end: "
        "z plus a correction that is detached.",
        straight_through,
        _prove_straight,
    ),
    Exercise(
        "14.3",
        "place = torch.arange(N); back = place[:, None] >= place. known.unsqueeze(2) says it of rows, "
        "known.unsqueeze(1) of columns; then it is & and | as the table says.",
        dual_mask,
        _prove_mask,
    ),
)
