"""The pipeline of MARDM and CDAMD: latents are unmasked, and motions are edited by unmasking a part of them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from minicmdm.asking import Asked
from minicmdm.data.features import features_of, features_to_joints
from minicmdm.live import MotionStream
from minicmdm.motion import Motion
from minicmdm.pipeline import MotionPipeline
from minicmdm.systems import VIEWS
from minicmdm.systems.mardm import unmask


class MaskedPipeline(MotionPipeline):
    """As `MotionPipeline`, for systems that know no scheduling matrix: `num_steps` are the head's for each latent."""

    def sampling(self, schedule: str | None, num_steps: int | None, uncertainty: int | None) -> dict[str, str | int]:
        """All of a motion is drawn together, hence "full"; how often, is the preset's `masked.iterations`."""
        if schedule not in (None, "full") or uncertainty not in (None, 0):
            raise ValueError(f"{self.preset.system} unmasks latents in random order: it has no schedule to choose")
        return {"schedule": "full", "num_steps": 10 if num_steps is None else num_steps, "uncertainty": 0}

    def stream(self, *_, **__) -> MotionStream:
        """There is none. ValueError."""
        raise ValueError(f"{self.preset.system} makes all of a motion together: to stream, take cmdm, flood or window")

    @torch.no_grad()
    def _latents(self, prompts, counts, luck, ask: Asked, given: Tensor | None = None, keep: Tensor | None = None):
        valid = torch.arange(max(counts)) < torch.tensor(counts)[:, None]  # (B,N)
        place = torch.arange(max(counts), dtype=torch.float32).expand(len(counts), -1)
        left = valid.sum(1, keepdim=True) - 1 - place if ask.tell_length else torch.full_like(place, -1.0)
        clock = torch.stack([place, left], dim=-1)  # (B,N,2)
        branches = [self._read(prompts), self._read([""] * len(prompts))]
        branches = branches[: 1 if ask.guidance_scale == 1 else 2]

        def look(shown: Tensor, known: Tensor) -> list[Tensor]:
            seen = []
            for words in branches:
                mask = words.mask[:, None].expand(-1, max(counts), -1)  # (B,N,S)
                seen.append(self.dit.conditions(shown, known & valid, words.embeddings, mask, valid, clock))
            return seen

        how = dict(num_steps=ask.num_steps, guidance_scale=ask.guidance_scale, solver=ask.solver)
        return unmask(look, self.dit, valid if keep is None else valid & ~keep, luck, given, **how)

    def _fill(self, z: Tensor, keep: Tensor, prompt: str, generator: torch.Generator, ask: Asked) -> Tensor:
        return self._latents([prompt], [len(keep)], [generator], ask, z, keep[None])

    def encode(self, features: np.ndarray | Tensor) -> Tensor:
        """Features (B,T,263), or the system's own view of them (B,T,67 or 66) -> normalised latents (B,N,C)."""
        features = np.asarray(features)
        if features.shape[-1] != self.preset.vae.input_dim:
            features = VIEWS[self.preset.system](features)
        return super().encode(features)

    def _motion(self, latents: Tensor, frames: int, caption: str) -> Motion:
        motion = super()._motion(latents, frames, caption)
        if self.preset.system == "cdamd":  # judges read features, whatever a system was trained on
            motion.features = features_of(motion.joints.astype(np.float64)).astype(np.float32)
        return motion

    def reconstruct(self, features: np.ndarray) -> np.ndarray:
        """One clip (T,D) through the autoencoder and back, cut to a multiple of 4 frames: features that judges read."""
        rebuilt = super().reconstruct(features)  # (T',67) or (T',66)
        return rebuilt if self.preset.system == "mardm" else features_of(features_to_joints(rebuilt))
