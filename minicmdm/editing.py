"""What stays of a motion that is edited: which latents, and what they may know.

MARDM's released editing encodes the whole clip and then hides what is to be made anew. But its encoder sees 86 frames
to each side, so the kept latents hold the answer. Here every kept part is encoded as if nothing else
existed. Even its features are: they smooth the heading over a second, and a step needs a next frame.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from minicmdm.data.features import coordinates, features_of
from minicmdm.motion import Motion

GIVEN = ("first_half", "second_half", "ends", "middle")
SHORTEST = 16  # frames: a quarter of them is one latent


def kept(encode: Callable[[Tensor], Tensor], motion: Motion, given: str, system: str = "cmdm") -> tuple[Tensor, Tensor]:
    """The latents (1,N,C) of what is given of a motion, zero elsewhere, and which they are, (N,) bool.

    `encode` gets features of each part by itself or, for CDAMD, the coordinates at which the part lies.
    ValueError: an unknown `given`, or a motion too short to have parts.
    """
    frames = len(motion)
    keep = kept_latents(-(-frames // 4), given)
    if frames < SHORTEST:
        raise ValueError(f"a motion of {frames} frames has no parts to keep: edit one of {SHORTEST} frames or more")
    joints = motion.joints.astype(np.float64)
    if system == "cdamd":  # places are what they are, whatever comes next
        seen = coordinates(features_of(joints))
    else:
        seen = np.concatenate([features_of(joints[4 * first : 4 * last]) for first, last in _runs(keep)])
    features = np.concatenate([seen, seen[-1:].repeat(-frames % 4, 0)])  # (4N,D)
    return encode_kept(encode, torch.from_numpy(features.astype(np.float32))[None], keep), keep


def kept_latents(num_latents: int, given: str) -> Tensor:
    """Which latents (N,) bool are given. Named by what is given, as papers use "prefix" in both senses.

    "first_half" and "second_half" keep half of them, "ends" a quarter at each end, "middle" all but those quarters.
    """
    if given not in GIVEN:
        raise ValueError(f"given must be one of {', '.join(GIVEN)}, and {given!r} came")
    place, half, quarter = torch.arange(num_latents), num_latents // 2, num_latents // 4
    inner = (place >= quarter) & (place < num_latents - quarter)
    return {"first_half": place < half, "second_half": place >= half, "ends": ~inner, "middle": inner}[given]


def encode_kept(encode: Callable[[Tensor], Tensor], features: Tensor, keep: Tensor) -> Tensor:
    """Encode the kept parts of a motion, each on its own: features (1,4N,D), keep (N,) -> (1,N,C), zero elsewhere.

    So nothing of what is to be made anew can be in them, however far the encoder sees.
    """
    parts = []
    for first, last in _runs(keep):
        z = encode(features[:, 4 * first : 4 * last])
        parts.append(z if keep[first] else torch.zeros_like(z))
    return torch.cat(parts, dim=1)


def _runs(keep: Tensor) -> list[tuple[int, int]]:
    """Where neighbours that are all kept, or all not, begin and end."""
    edges = torch.nonzero(keep[1:] != keep[:-1]).flatten().add(1).tolist()
    return list(zip([0, *edges], [*edges, len(keep)]))
