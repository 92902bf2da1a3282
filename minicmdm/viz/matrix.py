"""The FSS matrix explorer of notebook 08: turn K, L, N, the block and the kind, drag the row, and see what it buys.

Column over column: the scheduling matrix with a cursor at row m, the noise of every latent in that row, and the pose
that each draws if the sampler is stopped there. `look` makes all that can be said without a model, `Film` samples one
sentence under that matrix and decodes every row, `picture` draws both. The widget sends the same numbers to matrix.js,
which only paints: dragging m asks nobody, and a new schedule shows at once while its film is still being made.
"""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass
from importlib import resources

import numpy as np
import torch
from PIL import Image, ImageDraw

from minicmdm.data.features import features_to_joints
from minicmdm.data.skeleton import PARENTS
from minicmdm.diffusion.sampling import sample_steps
from minicmdm.diffusion.schedules import KINDS, cost, literal_matrix, schedule_matrix
from minicmdm.viz import plots
from minicmdm.viz.widgets import _with_png, anywidget, ipywidgets, traitlets

LITERAL = "Eq. 13 to the letter"
KIND = ["fss", *(kind for kind in KINDS if kind != "fss"), LITERAL]
# As `widgets.explore` takes them: the choices, the default first, or the least, the default and the greatest.
CONTROLS = dict(kind=KIND, num_steps=(1, 12, 20), uncertainty=(0, 3, 20), num_latents=(4, 12, 16), block_size=(1, 1, 4))
NAMES = dict(kind="kind", num_steps="steps K", uncertainty="stagger L", num_latents="latents N", block_size="block")
ROW = 24  # where the cursor stands at first
PAUSE = 0.35  # seconds without a change before a film is made
NOISY, HALF, CLEAN = (150, 62, 88), (236, 170, 120), (222, 233, 240)  # the colour of level K, of K / 2 and of 0
PALE = (225, 205, 210)  # what noise turns limbs into


@dataclass(frozen=True)
class Look:
    """What one schedule shows, row by row; if it cannot be, its matrix is empty and `problem` says why."""

    matrix: np.ndarray  # (M,N) noise levels
    colours: np.ndarray  # (K+1,3) uint8, the colour of each level
    problem: str = ""

    @property
    def facts(self) -> list[tuple[str, str]]:
        """The five numbers under their names."""
        if self.problem:
            return []
        names = ("rows M", "calls", "latents in flight", "calls to the first latent", "calls per further latent")
        price, ready = cost(self.matrix), (self.matrix > 0).sum(axis=0)  # (N,) the call after which each is clean
        later = int((ready > ready.min()).sum())  # latents that come after the first ones
        further = (price.calls - price.calls_to_first) / later if later else 0
        values = (price.rows, price.calls, price.latents_in_flight, price.calls_to_first, round(further, 2))
        return [(name, f"{value:g}") for name, value in zip(names, values)]

    def line(self, row: int) -> str:
        """Row m in words."""
        levels = self.matrix[row]
        clean, waiting = int((levels == 0).sum()), int((levels == self.matrix[0, 0]).sum())
        ready = int((np.append(levels, 1) > 0).argmax())  # how many at the left are clean, one after the other
        return (
            f"row m = {row} of {len(self.matrix) - 1}: {clean} latents clean, {len(levels) - clean - waiting} between, "
            f"{waiting} still pure noise. {4 * ready} frames, {ready / 5:.1f} s, can be shown."
        )


def look(kind: str, num_steps: int, uncertainty: int, num_latents: int, block_size: int) -> Look:
    """A state of the controls -> all its numbers. What is no schedule comes back with a `problem`, not an error."""
    noise = np.linspace(0, 1, num_steps + 1)
    stops = zip(CLEAN, HALF, NOISY)  # by channel
    colours = np.stack([np.interp(noise, [0, 0.5, 1], stop) for stop in stops], axis=-1).round().astype(np.uint8)
    try:
        if kind == LITERAL:
            matrix = literal_matrix(num_latents, num_steps, uncertainty, block_size)
        else:
            matrix = schedule_matrix(num_latents, num_steps, uncertainty, block_size, kind)
    except ValueError as error:
        why = f"is more than K = {num_steps}: a latent would wait on after the one before it"
        why = why if uncertainty > num_steps else f"is no stagger here: {error}"
        return Look(np.zeros((0, num_latents), np.int64), colours, f"L = {uncertainty} {why}.")
    return Look(matrix, colours)


class Film:
    """One sentence sampled under any matrix, every row decoded; a matrix met before costs nothing."""

    def __init__(self, pipe, prompt: str, seed: int = 0):
        self._pipe, self.prompt, self._seed, self._seen = pipe, prompt, seed, {}

    def known(self, matrix: np.ndarray) -> bool:
        """Whether it has been sampled."""
        return (matrix.shape, matrix.tobytes()) in self._seen

    @torch.no_grad()
    def __call__(self, matrix: np.ndarray) -> np.ndarray:
        """Matrix (M,N) -> where the last frame of each latent has its joints on paper (M,N,22,2), int16 millimetres.

        The pose is seen by the camera of `pose_strip`, from the foot of its root: to the right, and up.
        """
        pipe, count = self._pipe, matrix.shape[1]
        if not self.known(matrix):
            noise = pipe._noise(torch.Generator().manual_seed(self._seed), count)[None]
            # The model is not told the length, so that more latents only add to the right.
            denoise = pipe._denoiser([self.prompt], torch.ones(1, count, dtype=torch.bool), 3.0, False)
            film = torch.cat([step.z for step in sample_steps(denoise, matrix, noise)])  # (M,N,C)
            poses = np.stack([features_to_joints(row)[3::4] for row in pipe.decode(film).numpy()])  # (M,N,22,3)
            flat = (poses - poses[:, :, :1] * [1, 0, 1]) @ plots._CAMERA.T
            self._seen[matrix.shape, matrix.tobytes()] = np.clip(1000 * flat[..., :2], -9999, 9999).astype("<i2")
        return self._seen[matrix.shape, matrix.tobytes()]


# --- the picture for readers without a kernel -------------------------------------------------------------------------

WIDTH, LEFT, TOP, HEIGHT, BARS, POSES, HEAD = 1000, 64, 48, 230, 56, 130, 5  # pixels


def picture(seen: Look, row: int, poses: np.ndarray | None = None) -> Image.Image:
    """Facts, matrix with the cursor at `row`, noise of that row, and its poses (M,N,22,2) if there are any."""
    image = Image.new("RGB", (WIDTH, TOP + HEIGHT + BARS + POSES + 60), "white")
    pen, ink, small = ImageDraw.Draw(image), plots.INK, plots._font(12)
    if seen.problem:
        pen.text((20, 20), seen.problem, fill=(176, 20, 40), font=plots._font(14))
        return image
    levels, (rows, count) = seen.matrix[row], seen.matrix.shape
    steps, wide = seen.matrix[0, 0], (WIDTH - LEFT - 12) / count
    for i, (name, value) in enumerate(seen.facts):
        pen.text((LEFT + 180 * i, 4), value, fill=ink, font=plots._font(19))
        pen.text((LEFT + 180 * i, 27), name, fill=ink, font=small)
    heat = Image.fromarray(seen.colours[seen.matrix]).resize((WIDTH - LEFT - 12, HEIGHT), Image.Resampling.NEAREST)
    image.paste(heat, (LEFT, TOP))
    top, tall = TOP + HEIGHT * row / rows, max(HEIGHT / rows, 2)
    pen.rectangle([LEFT - 3, top - 1, WIDTH - 10, top + tall], outline=ink, width=2)
    for text, y in [("0", TOP + 6), (f"m = {row}", top + tall / 2), (str(rows - 1), TOP + HEIGHT - 6)]:
        if text[0] == "m" or abs(y - top - tall / 2) > 14:
            pen.text((LEFT - 8, y), text, fill=ink, font=small, anchor="rm")
    base, floor = TOP + HEIGHT + BARS + 6, TOP + HEIGHT + BARS + POSES + 6
    for text, y in [("noise k", base - BARS / 2), ("poses", floor - POSES / 2)]:
        pen.text((LEFT - 8, y), text, fill=ink, font=small, anchor="rm")
    for n, level in enumerate(levels.tolist()):
        left, middle = LEFT + n * wide, LEFT + (n + 0.5) * wide
        top = base - (BARS - 16) * level / steps - 2
        pen.rectangle([left + 2, top, left + wide - 3, base], fill=tuple(seen.colours[level].tolist()), outline=ink)
        pen.text((middle, top - 2), str(level), fill=ink, font=small, anchor="ms")
        pen.text((middle, floor + 14), f"latent {n}" if wide > 55 else str(n), fill=ink, font=small, anchor="ms")
        if poses is not None:
            place = [middle, floor - 8] + poses[row, n] * [1, -1] / 1000 * POSES / 2.3  # (22,2) pixels
            faded = plots.COLOURS + (0.86 * level / steps) * (np.array(PALE) - plots.COLOURS)  # (22,3)
            inks = list(map(tuple, faded.astype(int).tolist()))
            for j in range(1, len(PARENTS)):
                pen.line([*place[PARENTS[j]], *place[j]], fill=inks[j], width=3)
            plots._disc(pen, place[plots.HEAD_JOINT], HEAD, inks[plots.HEAD_JOINT])
    pen.text((LEFT, floor + 26), seen.line(row), fill=ink, font=plots._font(13))
    return image


# --- the widget -------------------------------------------------------------------------------------------------------


class MatrixCanvas(anywidget.AnyWidget):
    """What matrix.js paints: `data` when the schedule changes, `row` when the cursor moves."""

    _esm = resources.files("minicmdm.viz").joinpath("matrix.js").read_text(encoding="utf-8")
    data = traitlets.Dict().tag(sync=True)
    row = traitlets.Int(0).tag(sync=True)


class MatrixExplorer(ipywidgets.VBox):
    """Controls over the canvas. `film` turns a matrix into poses, as `Film` does; None shows none."""

    def __init__(self, film: Film | None = None):
        self._film, self._later, self._one = film, None, threading.RLock()
        defaults = {name: control[0 if name == "kind" else 1] for name, control in CONTROLS.items()}
        for name, control in CONTROLS.items():  # a broken state fails the notebook here
            for seen in [look(**(defaults | {name: value})) for value in control]:
                for row in {0, len(seen.matrix) // 2, len(seen.matrix) - 1}:
                    picture(seen, row, film(seen.matrix) if film and not seen.problem else None)
        self.inputs = {name: _control(name, control) for name, control in CONTROLS.items()}
        self.canvas, wide = MatrixCanvas(row=ROW), {"width": "70%"}
        self.row = ipywidgets.IntSlider(ROW, 0, ROW, description="row m", layout=wide).add_class("fss-row")
        self.clock = ipywidgets.Play(value=ROW, min=0, max=ROW, interval=90)
        # In the browser, so that dragging asks no kernel.
        ends = [(self.canvas, "row"), (self.clock, "value")]
        self._links = [ipywidgets.jslink((self.row, "value"), end) for end in ends]
        for name, widget in self.inputs.items():
            widget.add_class(f"fss-{name.replace('_', '-')}")  # hooks for tests in a browser
            widget.observe(self._changed, "value")
        self._show()
        top = ipywidgets.HBox([*self.inputs.values()], layout={"flex_flow": "row wrap"})
        super().__init__([top, ipywidgets.HBox([self.clock, self.row]), self.canvas])

    def _changed(self, _change) -> None:
        """Show the new schedule at once, and its film as soon as the controls rest."""
        if self._later is not None:
            self._later.cancel()
        if self._show(film=False):
            try:
                self._later = asyncio.get_running_loop().call_later(PAUSE, self._show)
            except RuntimeError:  # no kernel, nobody drags
                self._show()

    def _state(self) -> dict:
        return {name: widget.value for name, widget in self.inputs.items()}

    def _show(self, film: bool = True) -> bool:
        """Show what the controls say; True if its film is still to be made."""
        state, poses = self._state(), None
        seen = look(**state)
        rows, count = seen.matrix.shape
        problem, filmed = seen.problem, self._film is not None and rows > 0
        waits = filmed and not film and not self._film.known(seen.matrix)
        if filmed and not waits:
            try:
                poses = self._film(seen.matrix)
            except Exception as error:  # it would vanish unseen
                problem = f"{type(error).__name__}: {error}"
        data = {
            "rows": rows, "latents": count, "steps": len(seen.colours) - 1, "problem": problem,
            "levels": seen.matrix.astype(np.uint8).tobytes(), "colours": seen.colours.tobytes(),
            "facts": seen.facts, "lines": [seen.line(row) for row in range(rows)],
            "poses": b"" if poses is None else poses.tobytes(), "waits": waits,
            "head": plots.HEAD_JOINT, "bones": [[PARENTS[j], j, *plots.COLOURS[j]] for j in range(1, len(PARENTS))],
        }  # fmt: skip
        with self._one:  # JupyterLab lets callbacks run beside each other
            if state != self._state():
                return False  # the controls have moved on, and whoever moved them shows it
            self.seen, self.poses = seen, poses
            if rows:  # an impossible state leaves the cursor where it was
                self.row.max = self.clock.max = rows - 1
                self.canvas.row = min(self.canvas.row, rows - 1)
            self.canvas.data = data
        return waits

    def picture(self) -> Image.Image:
        """The static stand-in, at the row where the cursor is."""
        return picture(self.seen, self.row.value, self.poses)

    def _repr_mimebundle_(self, **options):
        return _with_png(super()._repr_mimebundle_(**options), self.picture())


def _control(name: str, control: list | tuple) -> ipywidgets.Widget:
    common = {"description": NAMES[name], "style": {"description_width": "initial"}, "layout": {"width": "270px"}}
    if isinstance(control, list):
        return ipywidgets.Dropdown(options=control, **common)
    least, default, greatest = control
    return ipywidgets.IntSlider(default, least, greatest, **common)
