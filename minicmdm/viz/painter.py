"""The noise painter of notebook 06: give each latent of a motion its own level, and see what the denoiser makes of it.

`Canvas` is one motion with one draw of noise, and `Canvas.paint(levels)` does what a training step of diffusion forcing
does with it: mix by each latent's level, ask for the velocity once, follow it to the data. `picture` draws the result.
`NoisePainter` is the same by hand: painter.js only paints bars and lets player.js play the motions.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from importlib import resources

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from minicmdm.data.features import features_to_joints
from minicmdm.data.skeleton import FPS
from minicmdm.diffusion.path import interpolate, level_to_time, velocity, velocity_to_data
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.viz.player import player_data, player_script
from minicmdm.viz.plots import pose_strip
from minicmdm.viz.widgets import _with_png, anywidget, png, traitlets

NUM_LEVELS = 20  # K, as the pipeline samples by default
NAMES = ("the motion itself", "noised as painted", "the model's guess of it")
SERIES = (  # of the picture and of painter.js: attribute, what it is, its full scale, its colour
    ("levels", "noise level k", NUM_LEVELS, "#b0707e"),
    ("loss", "loss", 2.0, "#454b57"),
    ("off", "guess off by (cm)", 12.0, "#2563c9"),
)


@dataclass(frozen=True)
class Painted:
    """One motion at one level for each latent, and what one call of the model says of it."""

    levels: np.ndarray  # (N,) whole numbers, 0 clean to K noise
    noisy: np.ndarray  # (T,22,3) metres: the noised latents, drawn as if they were clean
    guess: np.ndarray  # (T,22,3) where the predicted velocities lead
    loss: np.ndarray  # (N,) squared error of the velocity, the mean over channels: what training averages
    off: np.ndarray  # (N,) centimetres between a joint of the guess and the truth, pelvis on pelvis, mean of 4 frames

    @property
    def noise(self) -> np.ndarray:
        """How noisy each frame is, (T,) from 0 to 1."""
        return np.repeat(self.levels / NUM_LEVELS, 4)


class Canvas:
    """A motion (T,263), T a multiple of 4, with its sentence and one draw of noise, ready to be painted on."""

    def __init__(self, pipe, features: np.ndarray, caption: str, seed: int = 0):
        self.caption, self._pipe, self.z = caption, pipe, pipe.encode(features[None])  # (1,N,C)
        self.eps = torch.randn(self.z.shape, generator=torch.Generator().manual_seed(seed))
        self.count = self.z.shape[1]
        self.denoise = pipe._denoiser([caption], torch.ones(1, self.count, dtype=torch.bool), 1.0, True)
        self.truth = self._joints(self.z)

    @torch.no_grad()
    def paint(self, levels) -> Painted:
        """One level for each latent (N,) -> what comes of it. ValueError: other than N whole numbers from 0 to K."""
        levels = np.asarray(levels)
        whole = levels.shape == (self.count,) and levels.dtype.kind in "iu"
        if not whole or levels.min() < 0 or levels.max() > NUM_LEVELS:
            raise ValueError(f"expected {self.count} whole numbers from 0 to {NUM_LEVELS}, got {levels.tolist()!r:.80}")
        t = level_to_time(torch.tensor(levels[None], dtype=self.z.dtype), NUM_LEVELS)  # (1,N)
        z_t = interpolate(self.z, self.eps, t)
        v = self.denoise(z_t, t)
        guess = self._joints(velocity_to_data(z_t, v, t))
        loss = (v - velocity(self.z, self.eps)).square().mean(-1)[0].numpy()  # (N,)
        apart = (guess - guess[:, :1]) - (self.truth - self.truth[:, :1])  # (T,22,3)
        off = 100 * np.linalg.norm(apart, axis=-1).mean(-1).reshape(-1, 4).mean(-1)  # (N,)
        return Painted(levels, self._joints(z_t), guess, loss, off)

    def _joints(self, latents: torch.Tensor) -> np.ndarray:
        return features_to_joints(self._pipe.decode(latents)[0].numpy())


def presets(count: int) -> dict[str, list[int]]:
    """Rows of levels worth a look, for `count` latents."""
    K, half = NUM_LEVELS, count // 2
    return {
        "training draw": np.random.default_rng(3).integers(0, K + 1, count).tolist(),
        "one level": [K // 2] * count,
        "FSS row": schedule_matrix(count, K, 2)[K + 2 * (count // 3) - 2].tolist(),
        "clean past": [0] * half + [K] * (count - half),
        "clean future": [K] * half + [0] * (count - half),
        "hole": [K if half - 2 <= n < half + 2 else 0 for n in range(count)],
        "all noise": [K] * count,
        "all clean": [0] * count,
    }


def picture(canvas: Canvas, painted: Painted) -> Image.Image:
    """Levels, losses and distances, latent by latent, over strips of the noised motion and of the guess."""
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    for axis, (name, label, top, colour) in zip(figure.subplots(3, 1, sharex=True), SERIES):
        values = getattr(painted, name)
        axis.bar(np.arange(canvas.count), values, width=0.9, color=colour)
        axis.set(ylabel=label.replace(" by ", "\nby ").replace("level", "\nlevel"), ylim=(0, max(top, values.max())))
    axis.set(xlabel="latent n (4 frames each)", xlim=(-0.6, canvas.count - 0.4))
    parts = [Image.open(io.BytesIO(png(figure)))]
    for name, joints in zip(NAMES[1:], (painted.noisy, painted.guess)):
        parts.append(pose_strip(joints, caption=f"{name}: {canvas.caption}", noise=painted.noise))
    whole = Image.new("RGB", (max(part.width for part in parts), sum(part.height for part in parts)), "white")
    for part, top in zip(parts, np.cumsum([0, *(part.height for part in parts)]).tolist()):
        whole.paste(part, (0, top))
    return whole


class NoisePainter(anywidget.AnyWidget):
    """Drag over the bars to paint levels; the motions play below. Hooks for tests are listed in painter.js."""

    _esm = player_script() + resources.files("minicmdm.viz").joinpath("painter.js").read_text(encoding="utf-8")
    levels = traitlets.List(traitlets.Int()).tag(sync=True)  # what is painted
    shown = traitlets.Dict().tag(sync=True)  # what came of it
    plan = traitlets.Dict().tag(sync=True)  # what never changes

    def __init__(self, canvas: Canvas, levels: list[int] | None = None):
        rows = presets(canvas.count)
        for row in rows.values():  # all clean and all noise among them: a broken one fails the notebook here
            canvas.paint(row)
        super().__init__()
        self.canvas = canvas
        series = [dict(zip(("name", "label", "top", "colour"), one)) for one in SERIES]
        self.plan = {"presets": rows, "series": series, "top": NUM_LEVELS, "caption": canvas.caption}
        self.levels = list(next(iter(rows.values())) if levels is None else levels)
        self._show(canvas.paint(self.levels))
        self.observe(self._repaint, "levels")

    def _repaint(self, _change) -> None:
        try:
            self._show(self.canvas.paint(self.levels))
        except Exception as error:  # it would vanish unseen
            self.shown = {**self.shown, "levels": self.levels, "problem": f"{type(error).__name__}: {error}"}

    def _show(self, painted: Painted) -> None:
        self.painted = painted
        motions = [self.canvas.truth, painted.noisy, painted.guess]
        self.shown = {
            "levels": self.levels,
            "problem": "",
            "values": {name: getattr(painted, name).round(3).tolist() for name, *_ in SERIES},
            "motions": player_data(motions, list(NAMES), FPS, [None, painted.noise, painted.noise]),
        }

    def picture(self) -> Image.Image:
        """The static stand-in."""
        return picture(self.canvas, self.painted)

    def _repr_mimebundle_(self, **options):
        data, metadata = super()._repr_mimebundle_(**options)
        return _with_png(data, self.picture()), metadata
