"""What the model's tests share: weights without zeros, and who depends on whom."""

import torch


def randomise(module: torch.nn.Module, seed: int = 0) -> torch.nn.Module:
    """Replace every weight by noise, in float64. A zero-initialised layer would pass any causality test."""
    generator = torch.Generator().manual_seed(seed)
    module = module.double()
    with torch.no_grad():
        for weight in module.parameters():
            fan_in = weight[0].numel() if weight.ndim > 1 else 4
            weight.copy_(torch.randn(weight.shape, generator=generator, dtype=torch.float64) / fan_in**0.5)
    return module.eval()


def dependencies(function, x: torch.Tensor) -> torch.Tensor:
    """(outputs, inputs) bool: does position i of function(x) move when position j of x (B,T,D) does?"""
    with torch.no_grad():
        base, columns = function(x), []
        for j in range(x.shape[1]):
            moved = x.clone()
            moved[:, j] += 1.0
            columns.append((function(moved) - base).abs().amax(dim=(0, 2)) > 1e-9)
    return torch.stack(columns, dim=1)


def lower_triangle(count: int, group: int) -> torch.Tensor:
    """(count,count) bool: the group of i is not before the group of j."""
    index = torch.arange(count) // group
    return index[:, None] >= index[None, :]
