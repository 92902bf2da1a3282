"""The exercises of notebook 07: the causal DiT."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from minicmdm.exercises.frame import Exercise, must
from minicmdm.models.layers import Attention, modulate, rotate

SHAPES = [(1, 1, 2), (1, 3, 4), (2, 5, 6), (3, 7, 8)]  # batch, latents, width


def _normal(shape: tuple, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _close(a: Tensor, b: Tensor, within: float = 1e-9) -> bool:
    return isinstance(a, Tensor) and a.shape == b.shape and torch.allclose(a.to(b), b, rtol=within, atol=within)


def _prove_modulate(answer: Callable) -> None:
    for seed, shape in enumerate(SHAPES):
        x, shift, scale = (_normal(shape, 10 * seed + k) for k in range(3))
        nothing = torch.zeros(shape, dtype=torch.float64)
        law = "A zero shift and a zero scale leave x as it is: that is how a new block begins."
        must(_close(answer(x, nothing, nothing), x), law)
        must(_close(answer(x, shift, nothing), x + shift), "With a zero scale only the shift is added, once.")
        must(_close(answer(nothing, shift, scale), shift), "Where x is zero the scale has nothing to work on.")
        must(_close(answer(x, shift, scale), modulate(x, shift, scale)), "x is stretched by 1 + scale, then shifted.")


def _prove_rotate(answer: Callable) -> None:
    close = partial(_close, within=1e-4)  # angles in float32 are as good an answer
    for seed, (batch, count, width) in enumerate([(1, 1, 2), (1, 2, 2), (1, 3, 4), (2, 4, 8), (2, 9, 32)]):
        x, y = (_normal((batch, count, 2, width), 20 * seed + k) for k in range(2))
        here = torch.arange(count)
        turned = answer(x, here)
        must(turned.shape == x.shape, f"The shape {tuple(x.shape)} stays.")
        must(close(turned[:, :1], x[:, :1]), "Position 0 is not turned at all.")
        must(close(turned.norm(dim=-1), x.norm(dim=-1)), "A rotation keeps every vector's length.")
        dots = [(answer(x, here + far) * answer(y, here + far + 3)).sum(-1) for far in (0, 5, 40)]
        law = "Moved on together, two vectors keep their dot product: only their distance counts."
        must(close(dots[1], dots[0]) and close(dots[2], dots[0]), law)
        law = "Channel i pairs with i + d/2 and turns by position * 10000 ** (-2i/d): (a cos - b sin, b cos + a sin)."
        must(close(turned, rotate(x, here)), law)


def cached_step(
    attention: Attention, x: Tensor, keys: Tensor, values: Tensor, start: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Attend from new latents x (B,n,dim), at positions start, start+1, ..., to kept ones and causally to each other.

    keys, values (B,H,start,d) are those kept. -> output (B,n,dim), and keys and values (B,H,start+n,d) to keep next.
    """
    positions = torch.arange(start, start + x.shape[1])
    new_keys, new_values = attention.keys_values(x, positions)  # (B,H,n,d): the old ones are not computed again
    keys, values = torch.cat([keys, new_keys], dim=2), torch.cat([values, new_values], dim=2)
    mask = positions[:, None] >= torch.arange(keys.shape[2])  # (n,start+n)
    return attention.attend(x, keys, values, mask, positions), keys, values


def _prove_cached(answer: Callable) -> None:
    state = torch.random.get_rng_state()
    torch.manual_seed(0)
    attention = Attention(8, 2).double().requires_grad_(False)
    torch.random.set_rng_state(state)
    for seed, pieces in enumerate([(1,), (1, 1), (2,), (1, 2), (3, 1, 2), (4, 4, 1, 3)]):
        total = sum(pieces)
        x = _normal((1 + seed % 2, total, 8), seed)
        full = attention(x, x, torch.ones(total, total).tril().bool(), torch.arange(total))  # all at once
        keys = values = x.new_zeros(len(x), 2, 0, 4)
        start = 0
        for count in pieces:
            out, keys, values = answer(attention, x[:, start : start + count], keys, values, start)
            must(out.shape == (len(x), count, 8), f"{count} new latents get {count} answers of width 8.")
            kept = keys.shape[2] == values.shape[2] == start + count
            must(kept, f"After {start + count} latents as many keys and values are kept.")
            law = f"In pieces of {pieces} latents {start} to {start + count - 1} come out as in one full causal pass."
            must(_close(out, full[:, start : start + count]), law)
            start += count


EXERCISES = (
    Exercise(
        "07.1",
        "stretch x by one plus the scale, then add the shift. Why 'one plus'? Both start at zero.",
        modulate,
        _prove_modulate,
    ),
    Exercise(
        "07.2",
        "cut the last axis in two halves a and b; the angles are positions[:, None, None] * 10000.0 ** "
        "-(arange(d/2) / (d/2)), and a pair (a, b) turns into (a cos - b sin, b cos + a sin).",
        rotate,
        _prove_rotate,
    ),
    Exercise(
        "07.3",
        "the new latents stand at positions start, start + 1, ...; attention.keys_values(x, positions) gives their "
        "keys and values, torch.cat(..., dim=2) puts them after the kept ones, and the mask (n, start + n) lets each "
        "see what is kept, those before it and itself. Then attention.attend(x, keys, values, mask, positions).",
        cached_step,
        _prove_cached,
    ),
)
