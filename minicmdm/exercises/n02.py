"""The exercises of notebook 02: causal padding, the hunt for a leak, the receptive field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from minicmdm.exercises.frame import Exercise, must


def causal_padding(kernel_size: int, stride: int, dilation: int) -> int:
    """How many zeros to put before the input, so that output i ends with input stride*i + stride-1."""
    return (kernel_size - 1) * dilation + 1 - stride


def _prove_padding(answer: Callable) -> None:
    cases = [(1, 1, 1), (2, 1, 1), (3, 1, 1), (3, 1, 2), (2, 2, 1), (4, 2, 1), (3, 1, 9), (5, 4, 1), (5, 4, 2)]
    rng = np.random.default_rng(0)
    for _ in range(8):
        stride = int(rng.integers(1, 5))
        cases.append((stride + int(rng.integers(4)), stride, int(rng.integers(1, 6))))
    for kernel, stride, dilation in cases:
        left = int(answer(kernel, stride, dilation))
        must(left >= 0, "A padding is a number of zeros.")
        last = (kernel - 1) * dilation - left  # the last input that output 0 sees
        law = f"With {left} zeros in front, output 0 sees up to input {last}, and its group ends with {stride - 1}: "
        must(last <= stride - 1, law + "it looks ahead.")
        must(last >= stride - 1, law + "it ignores what is already known.")
        outputs = (10 * stride + left - (kernel - 1) * dilation - 1) // stride + 1
        must(outputs == 10, f"{10 * stride} inputs at stride {stride} give 10 outputs.")


@torch.no_grad()
def leaks(layer: Callable[[Tensor], Tensor], x: Tensor) -> bool:
    """True if any output of layer(x), (B,T,C) to (B,T,C'), depends on an input that comes after it."""
    whole = layer(x)
    other = 100 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    for t in range(1, x.shape[1]):
        for future in (other[:, t:], other[:, :0]):  # another future, and none at all
            out = layer(torch.cat([x[:, :t], future], dim=1))
            if not torch.allclose(out[:, :t], whole[:, :t], rtol=1e-9, atol=1e-9):
                return True
    return False


@dataclass(frozen=True)
class _Layer:
    """A function with a name, so that a failing call can be read."""

    name: str
    function: Callable[[Tensor], Tensor]

    def __call__(self, x: Tensor) -> Tensor:
        return self.function(x)

    def __repr__(self) -> str:
        return self.name


def _convolution(left: int, right: int) -> Callable[[Tensor], Tensor]:
    weight = torch.randn(2, 2, left + right + 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return lambda x: F.conv1d(F.pad(x.transpose(1, 2), (left, right)), weight).transpose(1, 2)


def _attention(x: Tensor, hidden: float, after: bool = False) -> Tensor:
    allowed = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool).tril()
    scores = x @ x.transpose(1, 2)
    weights = (scores if after else scores.masked_fill(~allowed, hidden)).softmax(-1)
    return (weights * allowed if after else weights) @ x


def _count(x: Tensor) -> Tensor:
    return torch.arange(1, x.shape[1] + 1, dtype=x.dtype)[None, :, None]


def _one_frame(x: Tensor) -> Tensor:
    out = x.clone()
    if x.shape[1] > 3:
        out[:, 2] = out[:, 2] + x[:, 3]
    return out


CAUSAL = (
    _Layer("each_frame_for_itself", lambda x: x.square() - 1),
    _Layer("convolution_padded_on_the_left", _convolution(2, 0)),
    _Layer("mean_of_the_past", lambda x: x.cumsum(1) / _count(x)),
    _Layer("greatest_so_far", lambda x: x - x.cummax(1).values),
    _Layer("norm_over_channels", lambda x: (x - x.mean(-1, keepdim=True)) / (1 + x.std(-1, keepdim=True))),
    _Layer("attention_masked_before_the_softmax", lambda x: _attention(x, -torch.inf)),
)
LEAKY = (
    _Layer("convolution_padded_on_both_sides", _convolution(1, 1)),
    _Layer("mean_over_time_taken_off", lambda x: x - x.mean(1, keepdim=True)),
    _Layer("roll_that_wraps_around", lambda x: x.roll(1, dims=1)),
    _Layer("attention_masked_after_the_softmax", lambda x: _attention(x, 0.0, after=True)),
    _Layer("scores_masked_with_zero", lambda x: _attention(x, 0.0)),
    _Layer("greatest_of_all", lambda x: x - x.amax(1, keepdim=True)),
    _Layer("one_frame_only", _one_frame),
    _Layer("one_channel_only", lambda x: torch.stack([x[..., 0], x[..., 1].flip(1).cumsum(1).flip(1)], -1)),
    _Layer("a_very_small_leak", lambda x: x + 1e-5 * x.flip(1)),
    _Layer("a_gate_that_a_great_number_shuts", lambda x: x * (x.abs().amax(1, keepdim=True) < 20)),
    _Layer("place_as_a_share_of_the_length", lambda x: x + _count(x) / x.shape[1]),
)


def _prove_leaks(answer: Callable) -> None:
    for layer in (CAUSAL[0], LEAKY[0], *CAUSAL[1:], *LEAKY[1:]):
        for seed, shape in enumerate([(1, 4, 2), (2, 6, 2), (1, 11, 2)]):
            x = torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
            given, guess = x.clone(), bool(answer(layer, x))
            must(torch.equal(x, given), "The input must stay as it was: change a copy.")
            if layer in CAUSAL:
                must(not guess, "This layer is causal: every output keeps its value under any other future.")
            else:
                must(guess, "This layer leaks: give it another future, or none, at every frame, and watch all outputs.")


def receptive_field(layers: list[tuple[int, int, int]]) -> int:
    """From the first to the last input that one output can see, through (kernel, stride, dilation) layers in order."""
    field, apart = 1, 1  # how far apart neighbours stand before this layer, counted in inputs of the whole stack
    for kernel, stride, dilation in layers:
        field += (kernel - 1) * dilation * apart
        apart *= stride
    return field


def _prove_field(answer: Callable) -> None:
    cases = [[(1, 1, 1)], [(3, 1, 1)], [(3, 1, 4)], [(4, 2, 1)], [(3, 1, 1), (3, 1, 1)], [(4, 2, 1), (3, 1, 1)]]
    rng = np.random.default_rng(0)
    for depth in (2, 3, 4, 5, 6):
        cases.append([tuple(map(int, rng.integers(1, (5, 3, 4)))) for _ in range(depth)])
    for layers in cases:
        seen = {0}  # backwards from one output, as a set of places; causal: the taps lie behind
        for kernel, stride, dilation in reversed(layers):
            seen = {place * stride - tap * dilation for place in seen for tap in range(kernel)}
        wanted, field = max(seen) - min(seen) + 1, int(answer(list(layers)))
        law = f"One output sees inputs over a span of {wanted}: "
        must(field <= wanted, law + "a kernel of k reaches (k-1) * dilation further back, and layers add up.")
        must(field >= wanted, law + "after a stride of 2, one step of the layers behind it is two steps of the input.")


EXERCISES = (
    Exercise(
        "02.1",
        "output 0 ends with input (k-1) * dilation - left. Where should it end, when a group has `stride` inputs?",
        causal_padding,
        _prove_padding,
    ),
    Exercise(
        "02.2",
        "for every frame t, replace all that comes from t on by something else (large, too), and once leave it "
        "out; then compare the outputs before t. Some layers leak into one frame only, some only by the length.",
        leaks,
        _prove_leaks,
    ),
    Exercise(
        "02.3",
        "walk through the layers with two numbers: the field so far, and how many inputs apart neighbours are.",
        receptive_field,
        _prove_field,
    ),
)
