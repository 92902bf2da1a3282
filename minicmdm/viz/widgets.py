"""The notebooks' widgets: thin skins on plain functions.

A notebook that runs from top to bottom does not prove that its widgets work: an error in a widget's callback is caught
and shown, and the run goes on. So every widget here calls its function itself before it is shown, at each control's
default, least and greatest value, and a broken one fails the notebook.

Every widget also carries a PNG of its first state, which is what a reader sees where no kernel runs (GitHub, a web
page). Nothing is loaded from the network.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable

import numpy as np
from PIL import Image

from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import MAX_FRAMES, MIN_FRAMES, Segment
from minicmdm.data.skeleton import FPS
from minicmdm.motion import Motion
from minicmdm.viz.player import player_data, player_script
from minicmdm.viz.plots import pose_strip

try:
    import anywidget
    import ipywidgets
    import traitlets
except ImportError as error:
    raise ImportError(f"widgets need the notebooks extra: pip install 'minicmdm[notebooks]' ({error})") from error

DPI = 80

# What turns player.js into a widget: a module with a `render` that follows the data.
_RENDER = """
export default {
  render({ model, el }) {
    const root = document.createElement("div");
    Object.assign(root.style, { background: "#fff", padding: "6px 10px" }); // also on a dark theme
    el.appendChild(root);
    let player = null;
    function show() {
      if (player) player.destroy();
      player = minicmdmPlayer(root, model.get("data"));
      if (!matchMedia("(prefers-reduced-motion: reduce)").matches) player.play();
    }
    show();
    model.on("change:data", show);
    return () => { model.off("change:data", show); player.destroy(); };
  },
};
"""


class SkeletonPlayer(anywidget.AnyWidget):
    """The player of motions (T, 22, 3) in metres, side by side in step, each under its caption.

    `noise` may hold for each motion how noisy its frames are, (T,) from 0 to 1, or None: noise is shown as colour.
    """

    _esm = player_script() + _RENDER
    data = traitlets.Dict().tag(sync=True)  # what viz.player.player_data packs

    def __init__(self, joints_list: list, captions: list[str], fps: float = FPS, noise: list | None = None):
        super().__init__()
        self.play(joints_list, captions, fps, noise)

    def play(self, joints_list: list, captions: list[str], fps: float = FPS, noise: list | None = None) -> None:
        """Show other motions. ValueError where `viz.player.player_data` finds one."""
        self.data = player_data(joints_list, captions, fps, noise)
        self._shown = list(zip(joints_list, captions, noise or [None] * len(captions)))

    def picture(self) -> Image.Image:
        """The static stand-in: a strip of poses for each motion, one below the other."""
        strips = [pose_strip(joints, caption=caption, noise=noise) for joints, caption, noise in self._shown]
        whole = Image.new("RGB", (strips[0].width, sum(strip.height for strip in strips)))
        heights = np.cumsum([0, *(strip.height for strip in strips)])
        for strip, top in zip(strips, heights.tolist()):
            whole.paste(strip, (0, top))
        return whole

    def _repr_mimebundle_(self, **options):
        data, metadata = super()._repr_mimebundle_(**options)
        return _with_png(data, self.picture()), metadata


class Explorer(ipywidgets.VBox):
    """Controls above the picture that a function makes of them; made by `explore`."""

    def __init__(self, fn: Callable, inputs: dict[str, ipywidgets.Widget], first: bytes):
        self._fn, self.inputs = fn, inputs
        self.image = ipywidgets.Image(value=first, format="png")
        self.image.layout.max_width = "100%"
        self.image.layout.object_fit = "contain"
        self.problem = ipywidgets.HTML()  # what went wrong, where the reader looks
        for widget in inputs.values():
            widget.observe(self._update, "value")
        super().__init__([*inputs.values(), self.image, self.problem])

    def _update(self, _change) -> None:
        try:
            self.image.value = png(self._fn(**{name: widget.value for name, widget in self.inputs.items()}))
            self.problem.value = ""
        except Exception as error:
            self.problem.value = html.escape(f"{type(error).__name__}: {error}", quote=False)

    def _repr_mimebundle_(self, **options):
        return _with_png(super()._repr_mimebundle_(**options), Image.open(io.BytesIO(self.image.value)))


def explore(fn: Callable, **controls) -> Explorer:
    """Sliders, menus and boxes over `fn(**controls)`, which returns a Matplotlib figure or a Pillow image.

    A control is (least, default, greatest) of whole or broken numbers, a list of choices with the default first, True
    or False, or a string. `fn` is called at once with all defaults and with each control at its ends (each choice of a
    list), whatever it raises is raised here. ValueError: a control of another kind.
    """
    tries = {name: _tries(name, control) for name, control in controls.items()}
    defaults = {name: values[0] for name, values in tries.items()}
    first = png(fn(**defaults))
    for name, values in tries.items():
        for value in values[1:]:
            png(fn(**(defaults | {name: value})))
    return Explorer(fn, {name: _input(name, control) for name, control in controls.items()}, first)


def _tries(name: str, control: object) -> list:
    """The values at which a control is tried, its default first."""
    if isinstance(control, tuple) and len(control) == 3 and control[0] <= control[1] <= control[2]:
        return [control[1], control[0], control[2]]
    if isinstance(control, list) and control:
        return control
    if isinstance(control, bool):
        return [control, not control]
    if isinstance(control, str):
        return [control]
    raise ValueError(
        f"{name}: a control is (least, default, greatest), a list of choices, a bool or a string, got {control!r}"
    )


def _input(name: str, control: object) -> ipywidgets.Widget:
    common = {"description": name.replace("_", " "), "style": {"description_width": "initial"}}
    if isinstance(control, list):
        return ipywidgets.Dropdown(options=control, value=control[0], **common)
    if isinstance(control, bool):
        return ipywidgets.Checkbox(value=control, indent=False, **common)
    if isinstance(control, str):
        return ipywidgets.Text(value=control, continuous_update=False, **common)
    least, default, greatest = control
    if all(isinstance(value, int) for value in control):
        return ipywidgets.IntSlider(default, least, greatest, continuous_update=False, **common)
    step = (greatest - least) / 100
    return ipywidgets.FloatSlider(default, min=least, max=greatest, step=step, continuous_update=False, **common)


def png(picture) -> bytes:
    """A Matplotlib figure or a Pillow image as PNG bytes; the figure is closed. ValueError: anything else."""
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    out = io.BytesIO()
    if isinstance(picture, Figure):
        picture.savefig(out, format="png", dpi=DPI)
        pyplot.close(picture)  # or the notebook would show it a second time
    elif isinstance(picture, Image.Image):
        picture.save(out, format="PNG", optimize=True)
    else:
        raise ValueError(f"a widget's function returns a figure or an image, and {type(picture).__name__} came")
    return out.getvalue()


def _with_png(data: dict | None, picture: Image.Image) -> dict:
    return {**(data or {}), "image/png": base64.b64encode(png(picture)).decode("ascii")}


# --- notebook 00 ------------------------------------------------------------------------------------------------------


def in_words(segments: list[Segment]) -> str:
    """What the oracle read, on one line: "walk (speed normal), 0.0-3.1 s; wave (side left), 3.1-6.0 s"."""
    return "; ".join(_segment_in_words(segment) for segment in segments)


def _segment_in_words(segment: Segment) -> str:
    stated = {name: getattr(segment, name) for name in ("side", "direction", "speed", "count", "overlay")}
    said = ", ".join(f"{name} {value}" for name, value in stated.items() if value is not None)
    times = f", {segment.start / FPS:.1f}-{segment.end / FPS:.1f} s"
    return segment.action + (f" ({said})" if said else "") + times


def make_motion(pipe, prompt: str, num_frames: int, seed: int) -> tuple[Motion | None, str]:
    """What `MotionMaker` does when its button is pressed: the motion and what the oracle reads from it.

    A request that cannot be met gives (None, why) instead of an error.
    """
    try:
        motion = pipe(prompt, num_frames=num_frames, seed=seed)
    except ValueError as error:
        return None, str(error)
    return motion, f"The oracle reads: {in_words(read_motion(motion.joints))}"


class MotionMaker(ipywidgets.VBox):
    """A sentence, a length and a seed; the button generates, the player plays, the oracle says what it sees."""

    def __init__(self, pipe, prompt: str = "a person walks", num_frames: int = 120, seed: int = 0):
        for frames in (MIN_FRAMES, MAX_FRAMES, num_frames):  # the lengths that the toy world knows
            motion, said = make_motion(pipe, prompt, frames, seed)
            if motion is None:
                raise ValueError(said)
        self._pipe = pipe
        wide = ipywidgets.Layout(width="98%")
        self.prompt = ipywidgets.Text(prompt, description="sentence", layout=wide)
        self.frames = ipywidgets.IntSlider(num_frames, MIN_FRAMES, MAX_FRAMES, 4, description="frames")
        self.seed = ipywidgets.BoundedIntText(seed, min=0, max=2**31 - 1, description="seed")
        self.button = ipywidgets.Button(description="Generate", button_style="primary")
        self.said = ipywidgets.HTML(html.escape(said, quote=False))  # unlike a Label it breaks long lines
        self.player = SkeletonPlayer([motion.joints], [motion.caption])
        self.button.on_click(self._generate)
        self.button.add_class("minicmdm-generate")  # hooks for tests in a browser
        self.said.add_class("minicmdm-said")
        row = ipywidgets.HBox([self.frames, self.seed, self.button])
        super().__init__([self.prompt, row, self.said, self.player])

    def _generate(self, _button) -> None:
        self.button.disabled, self.said.value = True, "generating ..."
        try:
            motion, said = make_motion(self._pipe, self.prompt.value, self.frames.value, self.seed.value)
            if motion is not None:
                self.player.play([motion.joints], [motion.caption])
        except Exception as error:  # a button's error would vanish unseen
            said = f"{type(error).__name__}: {error}"
        self.button.disabled, self.said.value = False, html.escape(said, quote=False)

    def _repr_mimebundle_(self, **options):
        return _with_png(super()._repr_mimebundle_(**options), self.player.picture())
