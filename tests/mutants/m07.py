"""Wrong answers to the exercises of notebook 07."""

import torch

from minicmdm.models.layers import rotate


def turned(x, positions, sign=1.0, interleaved=False, base=10_000.0, doubled=1.0):
    half = x.shape[-1] // 2
    angle = doubled * positions[:, None, None] * base ** -(torch.arange(half, dtype=x.dtype) / half)
    a, b = (x[..., ::2], x[..., 1::2]) if interleaved else (x[..., :half], x[..., half:])
    first, second = a * angle.cos() - sign * b * angle.sin(), b * angle.cos() + sign * a * angle.sin()
    if interleaved:
        return torch.stack([first, second], -1).flatten(-2)
    return torch.cat([first, second], -1)


def step(attention, x, keys, values, start, first=None, masked=True, queries=True, keep="all"):
    positions = torch.arange(x.shape[1]) + (start if first is None else first)
    new_keys, new_values = attention.keys_values(x, positions)
    all_keys, all_values = torch.cat([keys, new_keys], 2), torch.cat([values, new_values], 2)
    seen = start + torch.arange(x.shape[1])[:, None] >= torch.arange(all_keys.shape[2])
    out = attention.attend(x, all_keys, all_values, seen if masked else None, positions if queries else None)
    return (out, all_keys, all_values) if keep == "all" else (out, new_keys, new_values)


def raw_keys(attention, x, keys, values, start):
    """Keeps the keys unturned, and turns them all each time by where they stand: but the cache was turned already."""
    positions = torch.arange(start + x.shape[1])
    new_keys, new_values = attention.keys_values(x, positions[start:])
    keys, values = torch.cat([keys, new_keys], 2), torch.cat([values, new_values], 2)
    again = rotate(keys.transpose(1, 2), positions).transpose(1, 2)
    mask = positions[start:, None] >= positions
    return attention.attend(x, again, values, mask, positions[start:]), keys, values


MUTANTS = {
    "07.1": [
        lambda x, shift, scale: x * scale + shift,  # the "one plus" forgotten: a new block would erase x
        lambda x, shift, scale: (x + shift) * (1 + scale),  # shifted first
        lambda x, shift, scale: x * (1 + shift) + scale,  # the two exchanged
        lambda x, shift, scale: x * (1 + scale[:, :1]) + shift[:, :1],  # the first latent's time for all
        lambda x, shift, scale: x * (1 + scale.mean(-1, keepdim=True)) + shift,  # one scale for all channels
    ],
    "07.2": [
        lambda x, positions: turned(x, positions, sign=-1.0),  # the other way round: distances hold, the pairs do not
        lambda x, positions: turned(x, positions, interleaved=True),  # neighbours as pairs, another layout
        lambda x, positions: turned(x, positions, base=100.0),
        lambda x, positions: turned(x, positions + 1),  # counts from one
        lambda x, positions: turned(x, positions, doubled=2.0),
        lambda x, positions: x + positions[:, None, None],  # an added position, no rotation
        lambda x, positions: x,
    ],
    "07.3": [
        lambda *a: step(*a, first=0),  # every piece begins at position 0
        lambda *a: step(*a, masked=False),  # new latents see those after them
        lambda *a: step(*a, queries=False),  # the queries are not turned
        lambda *a: step(*a, keep="new"),  # the past is forgotten
        raw_keys,
    ],
}
