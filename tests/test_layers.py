"""Convolutions that cannot look ahead, rotary attention under a mask, RMSNorm."""

import pytest
import torch
import torch.nn.functional as F
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.models.layers import (
    Attention,
    CausalConv1d,
    KeyValueCache,
    ResidualBlock,
    RMSNorm,
    modulate,
    rotate,
    sinusoid,
)


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


@pytest.mark.parametrize("kernel, stride, dilation", [(3, 1, 1), (3, 1, 9), (1, 1, 1), (4, 2, 1), (5, 4, 2)])
def test_a_convolution_in_pieces_is_the_whole_convolution(kernel, stride, dilation):
    conv = randomise(CausalConv1d(2, 3, kernel, stride, dilation))
    x, states = torch.randn(2, 2, 48, dtype=torch.float64), {}
    pieces = [conv(piece, states) for piece in x.split([4, 12, 4, 8, 20], dim=-1)]
    assert torch.allclose(torch.cat(pieces, dim=-1), conv(x), rtol=1e-12, atol=1e-14)
    assert states[conv].shape == (2, 2, conv.padding[0])  # and the past that is kept does not grow
    if conv.padding[0]:  # the control: without its past a piece begins with zeros
        assert not torch.allclose(conv(x[..., 4:16]), pieces[1])


def test_a_convolution_that_looks_ahead_cannot_work_in_pieces():
    with pytest.raises(ValueError, match="looks ahead"):
        CausalConv1d(2, 2, 3, causal=False)(torch.zeros(1, 2, 8), {})


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


def test_no_mask_shows_everything(attention):
    layer, x, context = attention
    mask = torch.ones(2, 5, 4, dtype=torch.bool)
    assert torch.allclose(layer.attend(x, *layer.keys_values(context), None), layer(x, context, mask), rtol=1e-12)


def test_sampling_and_training_attend_alike_with_masks_of_truth_and_of_numbers(attention):
    layer, x, context = attention
    mask = torch.rand(2, 5, 4, generator=torch.Generator().manual_seed(0)) > 0.5
    added = torch.zeros(2, 5, 4).double().masked_fill(~mask, -torch.inf)
    blind = ~mask.any(-1)
    assert blind.any()  # a query that sees nothing: only a mask of truth may hold one
    trained = layer(x, context, mask)
    with torch.no_grad():  # the library's fused attention
        assert torch.allclose(layer(x, context, mask), trained, rtol=1e-9, atol=1e-12)
        fused = layer(x, context, added)
    for found in (layer(x, context, added), fused):
        assert torch.allclose(found[~blind], trained[~blind], rtol=1e-9, atol=1e-12)


def attend_one_by_one(layer, x, window, ahead=2):
    """Latents become final one at a time; before that each is written `ahead` times with passing contents."""
    cache = KeyValueCache(1, 2, 2, 4, window, x)
    out = []
    for i in range(x.shape[1]):
        for attempt in range(ahead, -1, -1):  # the last attempt is the final one, with nothing behind it
            active = x[:, i : i + 1 + attempt] + attempt
            cache.make_room(active.shape[1])
            positions = torch.arange(cache.end, cache.end + active.shape[1])
            keys, values = cache.write(0, *layer.keys_values(active, positions))
            out_i = layer.attend(
                active[:, :1], keys[:, :, : len(cache) + 1], values[:, :, : len(cache) + 1], None, positions[:1]
            )
        cache.keep(1)
        out.append(out_i)
    return torch.cat(out, dim=1), cache


def test_cached_attention_is_attention_over_a_window_wherever_its_slots_lie():
    torch.manual_seed(0)
    layer, x = randomise(Attention(8, heads=2)), torch.randn(2, 40, 8).double()
    place = torch.arange(40)
    for window in (40, 7):  # nothing slides; everything slides, and moves to the front five times
        out, cache = attend_one_by_one(layer, x, window, ahead=2 if window == 40 else 0)
        behind = place[:, None] - place
        mask = (behind >= 0) & (behind < window)
        assert torch.allclose(out, layer(x, x, mask, place), rtol=1e-9, atol=1e-12)
        assert cache.keys.shape[3] == cache.values.shape[3] == 2 * window and cache.end <= 2 * window
    assert not torch.allclose(out, layer(x, x, behind >= 0, place))  # the control: the window does hide


def test_a_cache_in_float32_does_not_wear_out():
    """After 2,000 latents the answer is as close to float64's as at the start: no position grows large."""
    torch.manual_seed(0)
    layer, x = randomise(Attention(8, heads=2)), torch.randn(2, 8, 8).double()
    wide, _ = attend_one_by_one(layer, x, 8, ahead=0)
    layer = layer.float()
    cache = KeyValueCache(1, 2, 2, 4, 8, x.float())
    with torch.no_grad():
        for i in range(2_000):
            cache.make_room(1)
            position = torch.tensor([cache.end])
            now = x[:, i % 8, None].float()
            keys, values = cache.write(0, *layer.keys_values(now, position))
            out = layer.attend(now, keys, values, None, position)
            cache.keep(1)
    assert (out[:, 0] - wide[:, -1]).abs().max() < 1e-5


def test_heads_must_divide_the_width_into_pairs():
    with pytest.raises(ValueError, match="multiple of 2"):
        Attention(12, heads=4)
