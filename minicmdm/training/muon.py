"""Muon: momentum whose step is made orthogonal, for the matrices inside a transformer.

A gradient of a matrix is usually a few strong directions and many weak ones, and most of what is to be learnt last is
in the weak ones. Muon (Jordan et al. 2024) gives all of them the same size: the momentum matrix U S V^T becomes about
U V^T, by five rounds of a polynomial that pushes every singular value towards 1 (Newton-Schulz), which takes products
only. Vectors, embeddings and the last layer stay with AdamW.

torch has had `torch.optim.Muon` since 2.9. This one makes the same step on older releases too and, as a small
transformer has many matrices of few shapes, does all of one shape in one product.
"""

from collections import defaultdict

import torch
from torch import Tensor, nn

ROUNDS, POLYNOMIAL = 5, (3.4445, -4.7750, 2.0315)  # of x, x^3 and x^5; singular values end within about .7 to 1.2
NESTEROV = 0.95


class Muon(torch.optim.Optimizer):
    """Muon for matrices of two dimensions, scaled so that AdamW's learning rates fit (an RMS step of 0.2 lr)."""

    def __init__(self, matrices: list[Tensor], lr: float):
        if wrong := [tuple(weight.shape) for weight in matrices if weight.ndim != 2]:
            raise ValueError(f"Muon steps matrices, and a weight of shape {wrong[0]} came")
        super().__init__(matrices, {"lr": lr})

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            alike = defaultdict(list)  # shape -> weights
            for weight in group["params"]:
                if weight.grad is not None:
                    alike[weight.shape].append(weight)
            for (rows, columns), weights in alike.items():
                nudges = []
                for weight in weights:
                    momentum = self.state[weight].setdefault("momentum", torch.zeros_like(weight))
                    momentum.lerp_(weight.grad, 1 - NESTEROV)
                    nudges.append(weight.grad.lerp(momentum, NESTEROV))
                steps = orthogonal(torch.stack(nudges)).to(weights[0].dtype)  # (W,rows,columns)
                scale = 0.2 * max(rows, columns) ** 0.5  # an orthogonal matrix has RMS 1 / sqrt(its longer side)
                torch._foreach_add_(weights, list(steps.unbind()), alpha=-group["lr"] * scale)


def orthogonal(matrices: Tensor) -> Tensor:
    """About U V^T for each of the matrices U S V^T (W,a,b), in bfloat16, which is exact enough."""
    x = matrices.bfloat16()
    tall = x.shape[-2] > x.shape[-1]
    x = x.mT if tall else x  # so that the product of x with itself is the smaller one
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp_min(1e-7)
    a, b, c = POLYNOMIAL
    for _ in range(ROUNDS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x


def inner_matrices(models: nn.Module) -> list[Tensor]:
    """The weights Muon is for: matrices in the repeated blocks of a transformer, not what embeds or reads out."""
    repeated, named = {"blocks", "word_blocks"}, models.named_parameters()
    return [w for name, w in named if w.ndim == 2 and repeated & set(name.split(".")) and w.requires_grad]
