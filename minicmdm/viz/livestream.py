"""The live stream of notebook 09: a skeleton that keeps moving, and a box in which to tell it what to do next.

`Actor` is the plain part: a stream of motion cut into chunks, which remembers from which frame on each sentence is
heard. `LiveStream` is its skin. livestream.js plays frames as they come and asks for the next chunk when about half a
second of them is left; the kernel makes it, sends it and is free again. Nothing loops in Python: who stops asking, gets
nothing.

A new prompt comes to those who wait twice: first the frames that are already with the player, then the latents that
are already in flight. With L = 2 and "new" the second wait alone is two seconds. Hence the choice of L = 4 and "active"
here, measured in the notebook.
"""

from __future__ import annotations

from importlib import resources

import numpy as np
from PIL import Image

from minicmdm.data.skeleton import skeleton_of
from minicmdm.live import USUAL
from minicmdm.viz.plots import pose_strip
from minicmdm.viz.widgets import _with_png, anywidget, traitlets

CHUNK = 8  # frames in an answer: two latents, a few hundredths of a second of work
OPENING = 20  # frames in the first one, a second
LOW = 12  # the player asks when fewer frames than this are left
PAST = 100  # frames back to which it is known who heard what: more than any player has left
QUICK = dict(num_steps=20, uncertainty=4, new_prompt="active")  # how it samples unless told otherwise


class Actor:
    """A stream in chunks of frames. `number` frames have been made; `told` says which sentence is heard from where."""

    def __init__(self, pipe, prompt: str, seed: int = 0, **how):
        self._stream = pipe.stream(prompt, seed=seed, **(QUICK | how))
        self.number = 0
        self.told = [(0, prompt)]  # (first frame that hears it, sentence), in order

    def say(self, prompt: str, lasts: int | None = USUAL) -> int:
        """Tell it something new, and return the first frame that hears it.

        ValueError: nobody can read this, an empty one for a start. The stream goes on as if nothing had been said.
        """
        if not isinstance(prompt, str) or not prompt.strip():
            raise ValueError("The prompt is empty: write what to do, like 'a person jumps twice', and send it.")
        prompt = " ".join(prompt.split())
        first = self.number + self._stream.reaction
        self._stream.prompt(prompt, lasts=lasts)
        self.told = [one for one in self.told if one[0] < first] + [(first, prompt)]  # nobody has heard those others
        return first

    def chunk(self, frames: int = CHUNK) -> np.ndarray:
        """The next frames (frames,22,3) in metres, float32. They continue those of the chunk before exactly."""
        joints = np.stack([next(self._stream) for _ in range(frames)]).astype("<f4")
        self.number += frames
        while len(self.told) > 1 and self.told[1][0] <= self.number - PAST:
            self.told.pop(0)  # so that an hour of prompts does not pile up
        return joints

    def acting(self, frame: int) -> str:
        """The sentence that a frame hears: one of the last PAST, or one to come."""
        return [prompt for first, prompt in self.told if first <= frame][-1]


class LiveStream(anywidget.AnyWidget):
    """A box for a prompt, a canvas for the motion, and a stream that is made while it is watched.

    The first second is made at once, so a stream that does not work fails the notebook. `how` goes to `pipe.stream`.

    Messages from the page: {"kind": "more"} asks for a chunk, {"kind": "say", "prompt": ...} tells the actor something.
    Messages to it: {"kind": "frames", "first", "told"} with the joints as float32 in a buffer; {"kind": "heard",
    "first", "prompt"}; {"kind": "problem", "text", "fatal"}, after which a fatal one has stopped the stream.
    """

    _esm = resources.files("minicmdm.viz").joinpath("livestream.js").read_text(encoding="utf-8")
    plan = traitlets.Dict().tag(sync=True)  # what never changes
    opening = traitlets.Bytes().tag(sync=True)  # the first frames, as in a message

    def __init__(self, pipe, prompt: str = "a person walks forward", seed: int = 0, **how):
        actor = Actor(pipe, prompt, seed, **how)
        first = actor.chunk(OPENING)
        super().__init__()
        self.actor, self._first, self._prompt = actor, first, prompt
        body = skeleton_of(first.shape[1])
        shown = {"parents": list(body.parents), "sides": body.sides, "head": body.head}
        self.plan = {"fps": body.fps, "low": LOW, "prompt": prompt, **shown}  # a trait misses later changes
        self.opening = first.tobytes()
        self.on_msg(self._answer)

    def _answer(self, _widget, content: dict, _buffers) -> None:
        """One message of the page; whatever goes wrong is told there, or nobody would see it."""
        try:
            if content.get("kind") == "more":
                number, joints = self.actor.number, self.actor.chunk()
                self.send({"kind": "frames", "first": number, "told": self.actor.told}, [joints.tobytes()])
            elif content.get("kind") == "say":
                self._say(content.get("prompt"))
        except Exception as error:
            self.send({"kind": "problem", "text": f"{type(error).__name__}: {error}", "fatal": True})

    def _say(self, prompt: str) -> None:
        try:
            first = self.actor.say(prompt)
        except ValueError as error:
            self.send({"kind": "problem", "text": str(error), "fatal": False})
        else:
            self.send({"kind": "heard", "first": first, "prompt": self.actor.told[-1][1]})

    def picture(self) -> Image.Image:
        """The static stand-in: the first second, as a strip of poses."""
        return pose_strip(self._first, caption=f"A live stream (it needs a kernel) begins: {self._prompt}")

    def _repr_mimebundle_(self, **options):
        data, metadata = super()._repr_mimebundle_(**options)
        return _with_png(data, self.picture()), metadata
