"""The exercises of notebook 09: one step, guidance, the window, and how late a prompt is heard."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from minicmdm.diffusion.path import euler_step
from minicmdm.diffusion.sampling import guided
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.exercises.frame import Exercise, must
from minicmdm.models.layers import KeyValueCache

SHAPES = [(1, 1, 1), (1, 2, 3), (2, 3, 2), (2, 7, 5), (3, 6, 4), (4, 11, 8)]  # (B,N,C)


def _random(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def _prove_step(answer: Callable) -> None:
    for seed, (batch, num_latents, channels) in enumerate(SHAPES):
        z_t, v = _random(seed, batch, num_latents, channels), _random(seed + 50, batch, num_latents, channels)
        t_from = _random(seed + 90, batch, num_latents).sigmoid()
        moves = _random(seed + 70, batch, num_latents) > 0
        moves[0, 0], moves[-1, -1] = False, seed % 2 == 1
        t_to = torch.where(moves, (t_from + 1) / 2, t_from)
        v[~moves] = torch.nan  # what nobody should read
        before = z_t.clone()
        out = answer(z_t, v, t_from, t_to)
        must(torch.equal(z_t, before), "z_t itself stays as it is: return a new tensor.")
        must(out.shape == z_t.shape, f"The answer has the shape of z_t, {tuple(z_t.shape)}.")
        law = "A latent whose time stays the same comes back bit for bit, even where v is NaN."
        must(torch.equal(out[~moves], z_t[~moves]), law)
        step = (t_to - t_from)[moves][:, None] * v[moves]
        law = "A latent moves by its own t_to - t_from times its own v, whatever the others do."
        must(torch.allclose(out[moves], z_t[moves] + step), law)


def guided_velocity(model: Callable, z_t: Tensor, t: Tensor, words: Tensor, null_words: Tensor, scale: float) -> Tensor:
    """v_null + s (v_text - v_null), both halves in one batch of 2B. `sampling.guided` also sees to the masks."""
    both = model(torch.cat([z_t, z_t]), torch.cat([t, t]), torch.cat([words, null_words]))  # (2B,N,C)
    v_text, v_null = both.chunk(2)
    return v_null + scale * (v_text - v_null)


def _prove_guidance(answer: Callable) -> None:
    batches: list[int] = []

    def model(z_t: Tensor, t: Tensor, words: Tensor, *_unused) -> Tensor:
        """Every sample hears its own words only, and not in proportion."""
        batches.append(len(words))
        return torch.tanh(z_t * (1 + t.unsqueeze(-1)) + words.square().mean((1, 2))[:, None, None])

    for seed, (batch, num_latents, channels) in enumerate(SHAPES):
        z_t, t = _random(seed, batch, num_latents, channels), _random(seed + 50, batch, num_latents).sigmoid()
        words, null_words = _random(seed + 90, batch, 3 + seed, 5), _random(seed + 70, batch, 3 + seed, 5)
        seen = torch.ones(batch, num_latents, 3 + seed, dtype=torch.bool)
        for scale in (0.0, 1.0, 2.5):
            wanted = guided(model, words, seen, null_words, seen, scale)(z_t, t)
            batches.clear()
            out = answer(model, z_t, t, words, null_words, scale)
            must(out.shape == z_t.shape, f"The velocity has the shape of z_t, {tuple(z_t.shape)}.")
            which = {0.0: "the velocity without the sentence", 1.0: "the velocity with the sentence"}
            which = which.get(scale, "as far beyond the sentence's velocity as s says, sample by sample")
            must(torch.allclose(out, wanted), f"At s = {scale:g} it is {which}.")
            must(len(batches) == 1, f"One call of the model does for both halves, and {len(batches)} were made.")


def kept(cached: list[int], count: int, window: int) -> list[int]:
    """Which of the cached latents stay when a call evaluates `count` more; see `KeyValueCache.make_room`."""
    return cached[max(0, len(cached) + count - window) :]


def _prove_window(answer: Callable) -> None:
    for window, counts in [(3, (1, 2, 3, 1)), (4, (2, 2, 4, 3)), (7, (1, 5, 7, 2)), (16, (11, 3, 16))]:
        for count in counts:
            for length in range(2 * window + 1):
                cached = list(range(length, 2 * length))
                cache = KeyValueCache(1, 1, 1, 2, window, torch.zeros(1))
                cache.end = length
                cache.make_room(count)
                out, told = list(answer(list(cached), count, window)), f"{length} cached, {count} new, window {window}"
                must(len(out) + count <= window, f"{told}: the call would see more than the window.")
                must(len(out) == len(cache), f"{told}: nobody leaves while there is room.")
                must(out == cached[length - len(out) :], f"{told}: the oldest leave first, and the order stays.")


def reaction(num_steps: int, uncertainty: int, block_size: int) -> int:
    """Frames from a finished block to the first block that has not started, under FSS; see `MotionStream.reaction`."""
    in_flight = -(-num_steps // uncertainty) - 1  # blocks that have started while the first one took its K steps
    return 4 * block_size * in_flight


def _prove_reaction(answer: Callable) -> None:
    for num_steps in (1, 2, 4, 5, 10, 20, 50):
        for uncertainty in sorted({1, 2, 3, num_steps // 2 or 1, num_steps}):
            for block_size in (1, 2, 3):
                if uncertainty > num_steps:
                    continue
                latents = block_size * (num_steps // uncertainty + 3)
                row = schedule_matrix(latents, num_steps, uncertainty, block_size)[num_steps]  # block 0 is clean
                flying = int(((row > 0) & (row < num_steps)).sum())
                law = f"The matrix's row {num_steps} has {flying} latents in flight, of 4 frames each, "
                out = answer(num_steps, uncertainty, block_size)
                must(out >= 4 * flying, law + "and all of their frames come first.")
                must(out <= 4 * flying, law + "and the next latent has not started: it hears.")


EXERCISES = (
    Exercise(
        "09.1",
        "the step is t_to - t_from, with a last axis for the channels. NaN times zero is NaN, so the product alone "
        "will not do: torch.where chooses.",
        euler_step,
        _prove_step,
    ),
    Exercise(
        "09.2",
        "torch.cat doubles z_t, t and words along the batch; chunk(2) takes the answer apart again.",
        guided_velocity,
        _prove_guidance,
    ),
    Exercise(
        "09.3",
        "how many are too many? So many leave from the front, and never fewer than none. Try a call that fills the "
        "whole window by itself.",
        kept,
        _prove_window,
    ),
    Exercise(
        "09.4",
        "block 0 needs K calls, and one block starts every L calls, the first at once. How many have started when it "
        "is clean? It is no longer among those that you wait for.",
        reaction,
        _prove_reaction,
    ),
)
