"""Frames as they come: a stream of latents, decoded and stood on the floor where the frame before it stood."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from torch import Tensor

from minicmdm.data.features import essential, features_to_joints, turn
from minicmdm.data.skeleton import FPS
from minicmdm.diffusion.streaming import LatentStream
from minicmdm.models.layers import States

LONGEST = 86_400  # seconds: a line of a timeline may last a day
USUAL = 60  # frames, the median of the training set's segments: to walk for ever is to walk again and again


class MotionStream:
    """Frames of joints, one by one and without an end: iterate for (22,3) in metres, or (B,22,3) for B prompts.

    Made by `MotionPipeline.stream`. Decoder and joints continue exactly where the latents before them ended.
    """

    def __init__(
        self, latents: LatentStream, decode: Callable[[Tensor, States], Tensor], single: bool, num_frames: int | None
    ):
        self.latents, self.single = latents, single
        self._decode, self._states, self._left = decode, {}, num_frames
        self._frames: list[np.ndarray] = []  # decoded and not yet handed out, the next one last
        self._before: np.ndarray | None = None  # (B,1,67) the last frame, which says how the next one moves
        self._yaw, self._place = 0.0, 0.0  # (B,), (B,1,1,3): heading and floor position of that frame

    def prompt(self, prompt: str | list[str | None], at: int | None = None, lasts: int | None = USUAL) -> None:
        """Say something new to all streams (or a list, None where nothing changes), now or from frame `at` on.

        `lasts` tells a model that has a clock how many frames it takes; then it is done again, until something else is
        said. None leaves that open, and no sentence of the training set lasts longer than 9.8 s. The change falls on
        the latent, four frames, whose middle it comes before. ValueError: a prompt that cannot be read, or a frame that
        has already started.
        """
        sentences = [prompt] * len(self.latents.generators) if isinstance(prompt, str) else list(prompt)
        if len(sentences) != len(self.latents.generators) or (self.single and not isinstance(prompt, str)):
            raise ValueError(f"{len(self.latents.generators)} streams need one prompt or as many, got {prompt!r:.80}")
        start = None if at is None else latents_before(at)
        length = 0 if lasts is None else max(1, latents_before((at or 0) + lasts) - latents_before(at or 0))
        self.latents.listen(sentences, start, length)

    @property
    def reaction(self) -> int:
        """How many frames from now the first one comes that hears a prompt said now."""
        hears = self.latents.finished if self.latents.new_prompt == "active" else self.latents.started
        return len(self._frames) + 4 * (hears - self.latents.finished)

    @property
    def horizon(self) -> int:
        """How many frames ahead of the next one latents have started, at most: so early must a prompt be known."""
        return 4 * self.latents.ahead

    def __iter__(self) -> Iterator[np.ndarray]:
        return self

    def __next__(self) -> np.ndarray:
        if self._left == 0:
            raise StopIteration
        while not self._frames:
            if (done := self.latents.step()).shape[1]:  # (B,n,C)
                joints = self._recover(self._decode(done, self._states))  # (B,4n,22,3)
                self._frames = list(joints.swapaxes(0, 1)[::-1])
        self._left = None if self._left is None else self._left - 1
        frame = self._frames.pop()
        return frame[0] if self.single else frame

    def _recover(self, features: Tensor) -> np.ndarray:
        """The joints (B,F,22,3) of features (B,F,D) that follow those of the call before."""
        x = essential(features.cpu().double().numpy())
        first = self._before is None
        x = x if first else np.concatenate([self._before, x], axis=1)
        joints = features_to_joints(x)  # as if its first frame stood at the origin, facing +Z
        joints = turn(joints, np.broadcast_to(self._yaw, len(x))) + self._place
        self._yaw = self._yaw - 2 * x[:, :-1, 0].sum(1)
        self._place = joints[:, -1:, :1] * [1.0, 0.0, 1.0]
        self._before = x[:, -1:]
        return (joints if first else joints[:, 1:]).astype(np.float32)


def latents_before(frame: int) -> int:
    """How many latents belong to what comes before a frame: those whose middle does (`latent_owners` in training)."""
    return (frame + 1) // 4


def timeline(lines: Iterable[bytes | str], fps: float = FPS) -> Iterator[tuple[int, str]]:
    """The (frames, prompt) of every line "seconds<TAB>prompt", as they come. ValueError: a line that says neither."""
    for number, line in enumerate(lines, start=1):
        try:
            line = line if isinstance(line, str) else line.decode("utf-8")
        except UnicodeDecodeError as error:
            raise ValueError(f"line {number} is not UTF-8 text: {error}") from error
        if not line.strip():
            continue
        seconds, tab, prompt = line.strip().partition("\t")
        try:
            frames = round(float(seconds) * fps)
        except (ValueError, OverflowError):  # no number, or an infinite one
            frames = 0
        if not tab or not prompt.strip() or not 1 <= frames <= LONGEST * fps:
            expected = f"seconds (0.05 to {LONGEST}), a tab and a prompt"
            raise ValueError(f"line {number}: expected {expected}, and {line.strip()[:80]!r} came")
        yield frames, prompt.strip()


def follow(
    stream: MotionStream, first: tuple[int, str], rest: Iterator[tuple[int, str]]
) -> Iterator[tuple[str, np.ndarray]]:
    """Every frame of a timeline with its prompt; `stream` was begun with the first. Ends with the timeline.

    The rest is asked for one by one, when latents that will hear the next prompt are about to start and no sooner: the
    prompts may be thought of while the frames come, and each begins on its own frame nevertheless.
    """
    number, ends = 0, [first]  # of prompts whose frames are to come: the frame where they end, and what they say
    while True:
        while (told := ends[-1][0]) < number + stream.horizon and (next_one := next(rest, None)):
            frames, prompt = next_one
            stream.prompt(prompt, at=told, lasts=frames)
            ends.append((told + frames, prompt))
        if ends[0][0] == number:
            ends.pop(0)
        if not ends:
            return
        yield ends[0][1], next(stream)
        number += 1


def frame_line(number: int, prompt: str, joints: np.ndarray) -> str:
    """One frame (22,3) as a line of JSON, joints in metres to a tenth of a millimetre."""
    return json.dumps({"frame": number, "prompt": prompt, "joints": [[round(float(x), 4) for x in j] for j in joints]})
