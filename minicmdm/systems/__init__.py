"""The systems. They share data, words, VAE layers, transformer, path, sampler and judges; see config.preset.

cmdm     causal attention, independent noise levels, FSS                     (the rest of this library)
flood    FloodDiffusion: bidirectional attention, triangles of levels        flood.py
mardm    masked latents and a diffusion head, on essential features          mardm.py
cdamd    the same on coordinates, with a dual-constrained mask               cdamd.py
window   ours: flood, but that finished latents look back, and all windows of a clip learn at once  diffusion/tiles.py
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minicmdm.config import Preset
from minicmdm.data.clips import MotionDataset
from minicmdm.data.features import coordinates, essential
from minicmdm.models.dit import CausalDiT
from minicmdm.systems.cdamd import DualTransformer
from minicmdm.systems.mardm import MaskedTransformer

MASKED = ("mardm", "cdamd")
VIEWS = {"mardm": essential, "cdamd": coordinates}  # of 263 features, where a system does not see all of them


def new_denoiser(plan: Preset) -> CausalDiT | MaskedTransformer:
    """The plan's last stage, with new weights."""
    if plan.system in MASKED:
        return MaskedTransformer(plan) if plan.system == "mardm" else DualTransformer(plan)
    return CausalDiT(plan.dit)


def seen_by(system: str, data: MotionDataset, like: MotionDataset | None = None) -> MotionDataset:
    """A data set of 263 features as a system sees it: all of them, MARDM's first 67, or CDAMD's 66 coordinates.

    Coordinates are in the clip's own frame, as released, so a crop starts anywhere in it. Their x, y and z are
    normalised each by one std for all joints, of `like` if given (what this function made of the training set).
    """
    if system not in MASKED:
        return data
    view = VIEWS[system]
    clips = [replace(clip, features=view(clip.features)) for clip in data.clips]
    if system == "mardm":
        mean, std = (view(x[None])[0] for x in (data.mean, data.std))
    elif like is not None:
        mean, std = like.mean, like.std
    else:
        frames = np.concatenate([clip.features for clip in clips]).astype(np.float64)  # (all frames,66)
        mean, std = frames.mean(0), np.tile(frames.reshape(len(frames), -1, 3).std(axis=(0, 1)), frames.shape[1] // 3)
    return replace(data, clips=clips, mean=mean.astype(np.float32), std=std.astype(np.float32))
