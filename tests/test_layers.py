"""Convolutions that cannot look ahead, rotary attention under a mask, RMSNorm."""

import pytest
import torch
import torch.nn.functional as F
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.models.layers import Attention, CausalConv1d, ResidualBlock, RMSNorm, modulate, rotate, sinusoid


def over_time(conv):
    return lambda x: conv(x.transpose(1, 2)).transpose(1, 2)


@pytest.mark.parametrize("kernel, stride, dilation", [(3, 1, 1), (3, 1, 9), (1, 1, 1), (4, 2, 1), (5, 4, 2)])
def test_causal_convolution_sees_the_past_and_its_own_group_only(kernel, stride, dilation):
    conv = randomise(CausalConv1d(2, 3, kernel, stride, dilation))
    sees = dependencies(over_time(conv), torch.zeros(1, 24, 2, dtype=torch.float64))
    assert sees.shape == (24 // stride, 24)
    for i, row in enumerate(sees):
        last = stride * i + stride - 1  # the last frame of output i's group
        expected = {last - j * dilation for j in range(kernel)} & set(range(24))
        assert set(row.nonzero().flatten().tolist()) == expected


def test_the_plain_convolution_looks_ahead_as_far_as_back():
    sees = dependencies(over_time(randomise(CausalConv1d(2, 2, 3, causal=False))), torch.zeros(1, 6, 2).double())
    assert set(sees[3].nonzero().flatten().tolist()) == {2, 3, 4}
    halved = CausalConv1d(2, 2, 4, stride=2, causal=False)
    assert halved(torch.zeros(1, 2, 8)).shape == (1, 2, 4)


def test_residual_block_adds_to_its_input():
    block = ResidualBlock(4, dilation=3).double()
    torch.nn.init.zeros_(block.mix.conv.weight)
    torch.nn.init.zeros_(block.mix.conv.bias)
    x = torch.randn(2, 4, 8, dtype=torch.float64)
    assert torch.equal(block(x), x)
    sees = dependencies(over_time(randomise(block)), torch.randn(1, 12, 4, dtype=torch.float64))
    assert not (sees & ~lower_triangle(12, 1)).any()


def test_rms_norm_matches_torch():
    norm = randomise(RMSNorm(6))
    x = torch.randn(2, 5, 6, dtype=torch.float64)
    assert torch.allclose(norm(x), F.rms_norm(x, (6,), norm.weight, eps=1e-6), rtol=1e-12)


def test_modulate():
    x, shift, scale = torch.randn(3, 2, 4, 6, dtype=torch.float64)
    assert torch.allclose(modulate(x, shift, scale), x * (1 + scale) + shift)


def test_sinusoid_of_zero_and_its_frequencies():
    assert torch.equal(sinusoid(torch.zeros(1, 1), 6), torch.tensor([[[1.0, 1, 1, 0, 0, 0]]]))
    t = torch.tensor([[2.5]], dtype=torch.float64)
    assert torch.allclose(
        sinusoid(t, 4)[0, 0],
        torch.tensor([2.5, 0.025, 2.5 - torch.pi / 2, 0.025 - torch.pi / 2]).cos().double(),
        atol=1e-6,
    )


def test_rotation_keeps_lengths_and_knows_only_distances():
    torch.manual_seed(0)
    q, k = torch.randn(2, 1, 1, 2, 8, dtype=torch.float64)

    def score(i, j):
        return (rotate(q, torch.tensor([i])) * rotate(k, torch.tensor([j]))).sum(-1)

    assert torch.allclose(rotate(q, torch.tensor([7])).norm(dim=-1), q.norm(dim=-1))
    assert torch.allclose(score(5, 2), score(12_345, 12_342), rtol=1e-8)  # far beyond any table
    assert not torch.allclose(score(5, 2), score(5, 3))
    assert torch.equal(rotate(q, torch.tensor([0])), q)


@pytest.fixture
def attention():
    torch.manual_seed(0)
    return randomise(Attention(8, heads=2)), torch.randn(2, 5, 8).double(), torch.randn(2, 4, 8).double()


def test_attention_matches_the_library(attention):
    layer, x, context = attention
    mask = torch.rand(2, 5, 4) > 0.4
    mask[:, :, 0] = True
    q, k = layer.query_norm(layer.query(x)), layer.key_norm(layer.key(context))
    q, k, v = (y.unflatten(-1, (2, 4)).transpose(1, 2) for y in (q, k, layer.value(context)))
    expected = F.scaled_dot_product_attention(q, k, v, attn_mask=mask.unsqueeze(1))
    expected = layer.out(expected.transpose(1, 2).flatten(2))
    assert torch.allclose(layer(x, context, mask), expected, rtol=1e-9)


def test_what_the_mask_hides_cannot_matter_and_what_it_shows_does(attention):
    layer, x, context = attention
    mask = torch.ones(2, 5, 4, dtype=torch.bool)
    mask[:, 2, 3] = False
    moved = context.clone()
    moved[:, 3] = 100.0
    change = (layer(x, moved, mask) - layer(x, context, mask)).abs().amax(dim=(0, 2))
    assert change[2] == 0 and (change[[0, 1, 3, 4]] > 1e-3).all()


def test_a_query_that_may_look_at_nothing_gets_the_bias_alone_and_finite_gradients(attention):
    layer, x, context = attention
    mask = torch.ones(2, 5, 4, dtype=torch.bool)
    mask[1, 3] = False
    out = layer(x.requires_grad_(), context.requires_grad_(), mask)
    assert torch.allclose(out[1, 3], layer.out.bias)
    out.square().sum().backward()
    assert x.grad.isfinite().all() and context.grad.isfinite().all() and context.grad.abs().sum() > 0


def test_keys_and_values_computed_earlier_give_the_same_answer(attention):
    layer, x, _ = attention
    positions, mask = torch.arange(5), torch.ones(5, 5, dtype=torch.bool).tril()
    whole = layer(x, x, mask, positions)
    first, second = layer.keys_values(x[:, :3], positions[:3]), layer.keys_values(x[:, 3:], positions[3:])
    keys, values = (torch.cat(pair, dim=2) for pair in zip(first, second))
    late = layer.attend(x[:, 3:], keys, values, mask[3:], positions[3:])
    assert torch.allclose(late, whole[:, 3:], rtol=1e-9)


def test_heads_must_divide_the_width_into_pairs():
    with pytest.raises(ValueError, match="multiple of 2"):
        Attention(12, heads=4)
