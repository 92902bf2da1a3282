"""Weights laid out once as the processor's matrix product wants them: for a stream, which multiplies few rows.

A call of autoregressive sampling evaluates the latents of one block, six rows with guidance, and each linear layer
fetches its whole matrix for them. torch lays a matrix out anew for every product, or takes it as it lies, which for so
few rows is twice as slow. oneDNN, which torch ships for CPUs, can keep it in its own layout: `packed` asks for that.
The numbers are the same up to float32's rounding.
"""

import copy

import torch
from torch import Tensor, nn

SMALLEST = 65_536  # numbers in a matrix: smaller ones stay in the cache, and for them packing costs more than it saves
_DTYPES = (torch.float32, torch.bfloat16)


class PackedLinear(nn.Module):
    """What a linear layer does, its weight laid out for products of about `rows` rows; it cannot learn."""

    def __init__(self, linear: nn.Linear, rows: int):
        super().__init__()
        self.weight = torch.ops.mkldnn._reorder_linear_weight(linear.weight.detach(), rows)
        self.bias = None if linear.bias is None else linear.bias.detach()

    def forward(self, x: Tensor) -> Tensor:
        # What torch.compile itself calls for a frozen model on a CPU, here without compiling. (...,in) -> (...,out)
        y = torch.ops.mkldnn._linear_pointwise(x.flatten(0, -2), self.weight, self.bias, "none", [], "")
        return y.unflatten(0, x.shape[:-1])


def can_pack(weight: Tensor) -> bool:
    """Whether this torch, on this machine, can keep a weight like this one in oneDNN's layout."""
    if weight.device.type != "cpu" or weight.dtype not in _DTYPES or not torch.backends.mkldnn.is_available():
        return False
    if weight.dtype == torch.bfloat16 and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    return all(hasattr(torch.ops.mkldnn, name) for name in ("_reorder_linear_weight", "_linear_pointwise"))


def packed(model: nn.Module, rows: int, among: str = "blocks", smallest: int = SMALLEST) -> nn.Module:
    """A twin of `model` whose large linear layers under the child `among` are packed; all else is shared with it.

    The twin keeps the weights of now: make a new one when the model has learnt. Where there is nothing to pack, or no
    way to, the model itself comes back.
    """
    large = [
        m for m in model.get_submodule(among).modules() if isinstance(m, nn.Linear) and m.weight.numel() >= smallest
    ]
    if not large or not can_pack(large[0].weight):
        return model
    twin = copy.deepcopy(model, {id(weight): weight for weight in model.parameters()})  # new modules, old weights
    for layer in list(twin.get_submodule(among).modules()):
        for name, child in layer.named_children():
            if isinstance(child, nn.Linear) and child.weight.numel() >= smallest:
                setattr(layer, name, PackedLinear(child, rows))
    return twin
