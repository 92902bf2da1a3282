"""The exercises of notebook 04: the two alignment losses and their weight."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.alignment import adaptive_weight, marginal_cosine, marginal_distance_matrix
from minicmdm.exercises.frame import Exercise, must

SHAPES = [(1, 1, 2, 2), (1, 2, 2, 3), (2, 2, 3, 2), (2, 4, 3, 5), (3, 7, 4, 6)]  # B, N, C, F


def _pairs():
    """Latents (B,N,C) and features (B,N,F) of growing shape."""
    for seed, (batch, latents, channels, width) in enumerate(SHAPES):
        generator = torch.Generator().manual_seed(seed)
        draw = lambda *shape: torch.randn(shape, generator=generator, dtype=torch.float64)  # noqa: B023, E731
        yield draw(batch, latents, channels), draw(batch, latents, width)


def _cosine(a: Tensor, b: Tensor) -> float:
    return float(a @ b / a.norm() / b.norm())


def _near(value: object, wanted: float) -> bool:
    return abs(float(torch.as_tensor(value).detach()) - wanted) < 1e-6


def _prove_cosine(answer: Callable) -> None:
    for _, f in _pairs():
        must(_near(answer(2 * f, f, 0.5), 0), "Latents that point where their features point cost nothing.")
        must(_near(answer(-f, f, 0.5), 1.5), "A latent that points the other way costs 2 - margin.")
        z = f.roll(1, dims=-1) + 0.3
        costs = [1 - _cosine(a, b) for a, b in zip(z.flatten(0, 1), f.flatten(0, 1))]
        for margin in (0.0, 0.25, 0.5, 1.0):
            wanted = sum(max(0.0, cost - margin) for cost in costs) / len(costs)
            law = f"With margin {margin} the mean of ReLU(1 - margin - cos) over {len(costs)} latents is {wanted:.3f}."
            must(_near(answer(z, f, margin), wanted), law)


def _prove_matrix(answer: Callable) -> None:
    for z, f in _pairs():
        must(_near(answer(3 * f, f, 0.0), 0), "Latents that are as alike as their features cost nothing.")
        for margin in (0.0, 0.25, 0.5):
            gaps = [
                abs(_cosine(z[b, i], z[b, j]) - _cosine(f[b, i], f[b, j]))
                for b in range(len(z))
                for i in range(z.shape[1])
                for j in range(z.shape[1])
            ]
            wanted = sum(max(0.0, gap - margin) for gap in gaps) / len(gaps)
            law = f"With margin {margin} the mean over the {len(gaps)} pairs i, j within the sequences is {wanted:.3f}."
            must(_near(answer(z, f, margin), wanted), law)


def _prove_weight(answer: Callable) -> None:
    for seed, (rows, columns) in enumerate([(1, 1), (1, 2), (2, 3), (4, 5)]):
        generator = torch.Generator().manual_seed(seed)
        weight, a, b = (torch.randn(rows, columns, generator=generator, dtype=torch.float64) for _ in range(3))
        weight.requires_grad_()
        rec, align = (a * weight).sum(), (b * weight).sum()  # their gradients are a and b
        wanted = float(a.norm() / b.norm())
        for share, law in [
            (1.0, "It is the norm of the reconstruction's gradient over the norm of the alignment's."),
            (3.0, "Three times the reconstruction, three times the weight."),
        ]:
            must(_near(answer(share * rec, align, weight), share * wanted), law)
        value = answer(rec, align, weight)
        must(
            not getattr(value, "requires_grad", False), "To the loss the weight is a number: no gradient flows into it."
        )
        flat = answer(rec, 0 * align, weight)
        must(
            float(torch.as_tensor(flat).detach()) <= 1e4,
            "An alignment that pulls at nothing is not divided by: the weight is at most 10,000.",
        )
        must(_near(answer(1e9 * rec, align, weight), 1e4), "The weight is clamped at 10,000.")
        (rec + align).backward()  # the training step that comes after; fails if a graph was thrown away
        must(torch.allclose(weight.grad, a + b), "Nothing is left behind in the parameter's own gradient.")


EXERCISES = (
    Exercise(
        "04.1",
        "torch.nn.functional.cosine_similarity over the last axis, then ReLU(1 - margin - cosine), then the mean.",
        marginal_cosine,
        _prove_cosine,
    ),
    Exercise(
        "04.2",
        "make all vectors of length 1; then x @ x.transpose(1, 2) holds every cosine within a sequence. "
        "Compare the two matrices, not the vectors.",
        marginal_distance_matrix,
        _prove_matrix,
    ),
    Exercise(
        "04.3",
        "torch.autograd.grad(loss, weight, retain_graph=True)[0].norm() for each; a floor of 1e-4 under the "
        "alignment's, a clamp from 0 to 1e4 over the ratio.",
        adaptive_weight,
        _prove_weight,
    ),
)
