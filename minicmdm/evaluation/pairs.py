"""What a judge learns from: clips with their captions, and near misses, captions that say one thing wrong.

Captions drawn at random hardly ever differ in a count or an order alone, so a judge that never sees a near miss is deaf
to them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from minicmdm.data import grammar
from minicmdm.data.dataset import Clip, MotionDataset
from minicmdm.data.programs import HELDOUT_PAIRS, OVERLAYS, SIDES, Program, pairs_of
from minicmdm.training.batches import POOL


def near_miss(program: Program, rng: np.random.Generator) -> Program | None:
    """Two neighbours exchanged, half the time, or one stated field changed; None where there is neither."""
    values = {"side": SIDES, "direction": SIDES, "speed": ("slow", "fast"), "count": (1, 2, 3), "overlay": OVERLAYS}
    swaps = [(*program[:i], *program[i : i + 2][::-1], *program[i + 2 :]) for i in range(len(program) - 1)]
    swaps = [p for p in swaps if p != program and not HELDOUT_PAIRS.intersection(pairs_of(p))]
    stated = [(i, f) for i, segment in enumerate(program) for f in values if getattr(segment, f) in values[f]]
    if swaps and (not stated or rng.random() < 0.5):
        return swaps[rng.integers(len(swaps))]
    if not stated:
        return None
    i, field = stated[rng.integers(len(stated))]
    others = [value for value in values[field] if value != getattr(program[i], field)]
    changed = replace(program[i], **{field: others[rng.integers(len(others))]})
    return (*program[:i], changed, *program[i + 1 :])


def draw_pairs(
    data: MotionDataset, count: int, generator: torch.Generator
) -> tuple[list[Clip], list[str], list[str], list[int]]:
    """Draw `count` clips, a caption of each, and near misses: captions that say one thing wrong, and of which clip.

    The clips are alike in length, so that no length alone gives a pair away.
    """
    pool = torch.randperm(len(data), generator=generator)[: POOL * count].tolist()
    pool.sort(key=lambda i: len(data.clips[i].features))
    slot = int(torch.randint(max(1, len(pool) // count), (), generator=generator))
    clips = [data.clips[i] for i in pool[slot * count : (slot + 1) * count]]
    rng = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
    misses = {i: near_miss(clip.program or (), rng) for i, clip in enumerate(clips)}
    misses = {i: grammar.caption(rng, miss) for i, miss in misses.items() if miss}
    return clips, [clip.captions[rng.integers(len(clip.captions))] for clip in clips], [*misses.values()], [*misses]
