"""What a data set is, wherever it came from: clips of features with words, and the numbers that normalise them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from minicmdm.data.programs import Program
from minicmdm.data.skeleton import skeleton_of


@dataclass(frozen=True)
class Clip:
    """One motion and its words: features (T, 263 or 251), captions, and each segment as (start, end, sentence)."""

    name: str
    features: np.ndarray
    captions: list[str]
    labels: list[tuple[int, int, str]]
    program: Program | None = None  # what was asked; None for real data
    realised: Program | None = None  # what was acted, with every field, start and end
    kind: str = "ordinary"


@dataclass(frozen=True)
class MotionDataset:
    """Clips of one split with the normalisation of their folder: mean and std (263,) or (251,)."""

    clips: list[Clip]
    mean: np.ndarray
    std: np.ndarray
    fingerprint: str

    def __len__(self) -> int:
        return len(self.clips)


def feature_statistics(features: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std (263,) or (251,) over all frames; the std averaged in each group of features, as HumanML3D's is."""
    stacked = np.concatenate(features).astype(np.float64)
    mean, std = stacked.mean(0), stacked.std(0)
    for group in (slice(0, 1), slice(1, 3), slice(3, 4), *skeleton_of(len(std)).blocks):
        std[group] = max(std[group].mean(), 1e-4)
    return mean.astype(np.float32), std.astype(np.float32)


def fingerprint_of(clips: list[Clip]) -> str:
    """A hash of all features and words, for a folder that brings none."""
    digest = hashlib.sha256()
    for clip in clips:
        digest.update(clip.features.tobytes() + "\n".join([clip.name, *clip.captions]).encode())
    return digest.hexdigest()[:16]
