"""What a body does in every frame, measured from its joints: the facts that the oracle reasons from.

Everything is relative to the body itself (its own ahead and left, its own shoulders), so no yaw and no place matters.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from minicmdm.data.programs import Segment
from minicmdm.data.skeleton import FPS


class Body:
    """The bodily facts, one array over time each; smoothed just enough to survive a centimetre of noise."""

    def __init__(self, joints: np.ndarray):
        self.frames = len(joints)
        j = gaussian_filter1d(joints, 1.2, axis=0, mode="nearest")
        across = (j[:, 1] - j[:, 2]) + (j[:, 16] - j[:, 17])  # to the left
        yaw = np.unwrap(np.arctan2(-across[:, 2], across[:, 0]))
        self.yaw = gaussian_filter1d(yaw, 2.0, mode="nearest")
        self.turn = gaussian_filter1d(np.gradient(yaw) * FPS, 4.0, mode="nearest")  # rad/s, positive to the left
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        velocity = np.gradient(joints[:, 0], axis=0) * FPS
        velocity = gaussian_filter1d(velocity, 3.5, axis=0, mode="nearest")
        self.ahead = velocity[:, 0] * s + velocity[:, 2] * c  # m/s
        self.left = velocity[:, 0] * c - velocity[:, 2] * s
        self.speed = np.hypot(self.ahead, self.left)
        local = j - j[:, :1]
        self.local = np.stack(
            [
                local[..., 0] * c[:, None] - local[..., 2] * s[:, None],
                local[..., 1],
                local[..., 0] * s[:, None] + local[..., 2] * c[:, None],
            ],
            -1,
        )  # (T, 22, 3): left, up, ahead of the pelvis
        self.height = j[:, 0, 1]
        self.toes = j[:, [10, 11], 1]  # (T, 2) left, right
        self.feet = gaussian_filter1d(joints[:, [10, 11]].mean(1)[:, [0, 2]], 4.0, axis=0, mode="nearest")
        self.feet_speed = np.linalg.norm(np.gradient(self.feet, axis=0), axis=1) * FPS
        self.toe_ahead = self.local[:, [10, 11], 2]
        spine = self.local[:, 12]
        self.bend = np.arctan2(spine[:, 2], spine[:, 1])  # rad, positive forward
        hand = self.local[:, [20, 21]] - self.local[:, [16, 17]]  # wrist from shoulder
        elbow = self.local[:, [18, 19]] - self.local[:, [16, 17]]
        self.hand_up, self.hand_ahead = hand[..., 1], hand[..., 2]
        self.elbow_out = elbow[..., 0] * np.array([1, -1])
        self.fore_out = (hand - elbow)[..., 0]
        self.hands_apart = np.linalg.norm(j[:, 20] - j[:, 21], axis=-1)
        # What the arms do: both up, one up beside the body, both in front of the chest.
        up = self.hand_up > 0.04
        out = self.elbow_out > 0.11
        self.raised = up.all(1) & (self.hand_up.min(1) > 0.28)
        self.waving = np.stack([up[:, 0] & out[:, 0] & ~up[:, 1], up[:, 1] & out[:, 1] & ~up[:, 0]], 1)  # (T, 2)
        front = (self.hand_ahead > 0.16).all(1) & (self.hands_apart < 0.62) & (np.abs(self.hand_up + 0.2).max(1) < 0.24)
        together = self.hands_apart < 0.20
        self.clapping = grow(together & front, 12) & grow(front & (self.hands_apart > 0.27), 12) & front


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Stretches of True as (start, end), end exclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def bridge(mask: np.ndarray, gap: int) -> np.ndarray:
    """Fill gaps shorter than or equal to `gap` between two stretches of True."""
    out = mask.copy()
    stretches = runs(mask)
    for (_, a), (b, _) in zip(stretches, stretches[1:]):
        if b - a <= gap:
            out[a:b] = True
    return out


def grow(mask: np.ndarray, by: int) -> np.ndarray:
    """True within `by` frames of a True, for clips of any length."""
    return np.convolve(mask, np.ones(2 * by + 1))[by : by + len(mask)] > 0


def covered(episodes: list[Segment], frames: int) -> np.ndarray:
    """The frames that some episode holds already: (frames,) bool."""
    out = np.zeros(frames, bool)
    for e in episodes:
        out[e.start : e.end] = True
    return out


def overlay(body: Body, start: int, end: int) -> str | None:
    """What the arms do through most of an episode of the legs."""
    inner = slice(start + (end - start) // 6, max(end - (end - start) // 6, start + 1))
    found = {
        "raise_arms": body.raised[inner].mean(),
        "wave_left": body.waving[inner, 0].mean(),
        "wave_right": body.waving[inner, 1].mean(),
        "clap": body.clapping[inner].mean(),
    }
    best = max(found, key=found.get)
    return best if found[best] > 0.5 else None


def rate(signal: np.ndarray) -> float:
    """Frequency (Hz) of the strongest oscillation of a short signal."""
    x = (signal - np.polyval(np.polyfit(np.arange(len(signal)), signal, 1), np.arange(len(signal)))) * np.hanning(
        len(signal)
    )
    spectrum = np.abs(np.fft.rfft(x, 512))
    hertz = np.fft.rfftfreq(512, 1 / FPS)
    spectrum[(hertz < 0.45) | (hertz > 5)] = 0
    return float(hertz[spectrum.argmax()])
