"""What a data set is, wherever it came from: clips of features with words, and the numbers that normalise them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minicmdm.data.programs import Program

_GROUPS = [(0, 1), (1, 3), (3, 4), (4, 67), (67, 193), (193, 259), (259, 263)]  # features that share one Std


@dataclass(frozen=True)
class Clip:
    """One motion and its words: features (T, 263), captions, and for each segment (start, end, sentence) in frames."""

    name: str
    features: np.ndarray
    captions: list[str]
    labels: list[tuple[int, int, str]]
    program: Program | None = None  # what was asked; None for real data
    realised: Program | None = None  # what was acted, with every field, start and end
    kind: str = "ordinary"


@dataclass(frozen=True)
class MotionDataset:
    """Clips of one split with the normalisation of their folder: mean and std (263,)."""

    clips: list[Clip]
    mean: np.ndarray
    std: np.ndarray
    fingerprint: str

    def __len__(self) -> int:
        return len(self.clips)


def feature_statistics(features: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std (263,) over all frames; the std averaged within each group of features, as HumanML3D's is."""
    stacked = np.concatenate(features).astype(np.float64)
    mean, std = stacked.mean(0), stacked.std(0)
    for a, b in _GROUPS:
        std[a:b] = max(std[a:b].mean(), 1e-4)
    return mean.astype(np.float32), std.astype(np.float32)
