"""From a sentence to a motion: tokenise, sample latents under a schedule, decode, recover the joints.

    pipe = MotionPipeline.from_pretrained("toy")
    motion = pipe("a person walks, then waves the left hand", num_frames=120, seed=0)

A motion depends on its own prompt, length and seed, and never on what else is in its batch: each prompt has its own
generator, and the noise for the longest motion is drawn first and then cut. (Solvers that draw noise at every step
draw it for the longest of the batch, so there the company counts.) As the model is causal, a longer motion
of the same prompt and seed begins like the shorter one, unless the model is told how long it is to be (`tell_length`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import minicmdm
from minicmdm.data.features import features_to_joints
from minicmdm.data.skeleton import Skeleton, skeleton_of
from minicmdm.diffusion.sampling import SOLVERS, Denoise, from_noise_prediction, guided, sample
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.diffusion.streaming import LatentStream
from minicmdm.live import USUAL, MotionStream, latents_before
from minicmdm.models.layers import States
from minicmdm.models.text import Words
from minicmdm.motion import Motion
from minicmdm.training import checkpoints

MIN_FRAMES, MAX_FRAMES = 4, 196  # one latent, and the longest motion of HumanML3D (9.8 s)
MAX_STEPS = 1000
MAX_GUIDANCE = 100.0
TOGETHER = 64  # how many motions are sampled in one batch
ASSETS = Path(minicmdm.__file__).parent / "assets"


class MotionPipeline:
    """The front door: a checkpoint that answers sentences with motions."""

    def __init__(self, checkpoint: checkpoints.Checkpoint):
        self.preset = checkpoint.preset
        self.vae = checkpoint.vae
        self.dit = checkpoint.dit
        self.text = checkpoint.text
        self.stats = checkpoint.stats
        self.card = checkpoint.card

    @classmethod
    def from_pretrained(cls, name: str | Path = "toy") -> MotionPipeline:
        """Load the shipped checkpoint by its name, "toy", or any checkpoint by its folder.

        Raises FileNotFoundError or ValueError where there is none, or one that is cut short, changed or foreign.
        """
        if not str(name).strip():
            raise ValueError('the checkpoint name is empty: give "toy" or a folder made by `minicmdm train --out`')
        folder = Path(name)
        if str(name) == "toy" and not (folder / "card.json").is_file():
            folder = ASSETS / "toy"
        return cls(checkpoints.load_checkpoint(folder))

    @property
    def skeleton(self) -> Skeleton:
        """The body that its training data had, with its frame rate."""
        return skeleton_of(self.preset.vae.input_dim)

    def save_pretrained(self, folder: str | Path) -> Path:
        """Write the checkpoint (weights, text encoder, statistics, card) into a folder, made if missing."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        checkpoints.save_vae(folder, self.vae, self.stats)
        checkpoints.save_dit(folder, self.dit)
        checkpoints.save_text(folder, self.text)
        facts = {key: value for key, value in self.card.items() if key not in ("format", "preset", "files")}
        checkpoints.write_card(folder, self.preset, facts)
        return folder

    def __call__(
        self,
        prompt: str | Sequence[str],
        num_frames: int | Sequence[int] = 120,
        *,
        schedule: str = "fss",
        num_steps: int = 20,
        uncertainty: int = 2,
        guidance_scale: float = 3.0,
        solver: str | None = None,
        block_size: int | None = None,
        seed: int | Sequence[int] = 0,
        tell_length: bool = True,
    ) -> Motion | list[Motion]:
        """Generate a Motion for a prompt, or a list of them for a list of prompts.

        `num_frames` (4..196 at 20 fps) and `seed` are one for all or one for each. `schedule` is one of
        `schedules.KINDS`, with K = `num_steps` and L = `uncertainty`; `solver` is one of `sampling.SOLVERS`, by default
        "euler", or "ddpm" for a model that predicts noise; `block_size` is the model's own unless given.
        With `tell_length` a model that has a clock knows how long the motion is to be, and paces itself; without, a
        longer motion begins exactly like a shorter one.
        Raises ValueError for anything that cannot be asked.
        """
        single = isinstance(prompt, str)
        prompts = [prompt] if single else _as_list(prompt, "prompt", "a string or a list of strings")
        for text in prompts:
            self._check_prompt(text)
        frames = [_check_frames(n) for n in _spread(num_frames, len(prompts), "num_frames")]
        seeds = [_integer(s, "seed", 0, 2**63 - 1) for s in _spread(seed, len(prompts), "seed")]
        num_steps = _integer(num_steps, "num_steps", 1, MAX_STEPS)
        scale = _check_guidance(guidance_scale)
        block_size = self.preset.dit.block_size if block_size is None else _integer(block_size, "block_size", 1, 49)
        schedule_matrix(1, num_steps, uncertainty, block_size, schedule)  # refuse a bad schedule before any work
        solver = solver or {"flow": "euler", "ddpm": "ddpm"}[self.preset.dit.path]
        if solver not in SOLVERS:
            raise ValueError(f"unknown solver {solver!r}: expected one of {', '.join(SOLVERS)}")

        motions: dict[int, Motion] = {}
        order = sorted(range(len(prompts)), key=lambda i: frames[i])
        for first in range(0, len(order), TOGETHER):
            chosen = order[first : first + TOGETHER]
            counts = [-(-frames[i] // 4) for i in chosen]  # latents: frames / 4, rounded up
            luck = [torch.Generator().manual_seed(seeds[i]) for i in chosen]
            asked = [prompts[i] for i in chosen]
            if solver == "euler" and schedule != "trapezoid" and self.preset.dit.attention == "causal":
                how = dict(schedule=schedule, num_steps=num_steps, uncertainty=uncertainty, block_size=block_size)
                how |= dict(guidance_scale=scale, num_latents=max(counts), lasts=counts if tell_length else 0)
                # The same numbers for less work. It knows no padding, but causal latents do not see what comes later.
                latents = LatentStream(self.dit, self._read, self._read([""]), asked, luck, **how).drain()
            else:
                noise = torch.stack([self._noise(generator, max(counts)) for generator in luck])  # (B,N,C)
                valid = torch.arange(max(counts)) < torch.tensor(counts)[:, None]  # (B,N)
                matrix = schedule_matrix(max(counts), num_steps, uncertainty, block_size, schedule)
                denoise = self._denoiser(asked, valid, scale, tell_length)
                latents = sample(denoise, matrix, noise, solver=solver, path=self.preset.dit.path, generator=luck)
            for i, count, one in zip(chosen, counts, latents):  # a VAE that looks ahead must not see padding
                features = self.decode(one[None, :count])[0, : frames[i]].numpy()  # (T,D)
                joints = features_to_joints(features).astype(np.float32)  # (T,22,3)
                motions[i] = Motion(joints, features, prompts[i], self.skeleton.fps)
        return motions[0] if single else [motions[i] for i in range(len(prompts))]

    def stream(
        self,
        prompt: str | Sequence[str],
        *,
        schedule: str = "fss",
        num_steps: int = 20,
        uncertainty: int = 2,
        guidance_scale: float = 3.0,
        seed: int | Sequence[int] = 0,
        block_size: int | None = None,
        window: int | None = None,
        new_prompt: str = "new",
        num_frames: int | None = None,
        lasts: int | None = USUAL,
    ) -> MotionStream:
        """Begin a motion without an end: iterate for frames (22,3), and call `prompt` on it at any time.

        A list of prompts makes as many streams in step, frames (B,22,3). `lasts` says how many frames the prompt takes,
        and then it is done again, until something else is said; with None nobody knows, and the stream is what
        `pipe(prompt, tell_length=False)` gives, as long as its `window` of latents holds. A `new_prompt` is heard by
        the "new" latents only, or by the "active" ones in flight too. `num_frames` gives the stream an end after all.
        Raises ValueError for anything that cannot be asked.
        """
        if self.preset.dit.path != "flow":
            raise ValueError(
                "this model predicts noise, and the stream steps along a velocity: generate motions instead"
            )
        single = isinstance(prompt, str)
        prompts = [prompt] if single else _as_list(prompt, "prompt", "a string or a list of strings")
        seeds = [_integer(s, "seed", 0, 2**63 - 1) for s in _spread(seed, len(prompts), "seed")]
        num_frames = num_frames if num_frames is None else _integer(num_frames, "num_frames", 1, 2**31)
        lasts = lasts if lasts is None else _integer(lasts, "lasts", 1, 2**31)

        def read(sentences: list[str]) -> Words:
            for sentence in sentences:
                self._check_prompt(sentence)
            return self._read(sentences)

        for text in prompts:
            self._check_prompt(text)
        latents = LatentStream(
            self.dit,
            read,
            self._read([""]),
            prompts,
            [torch.Generator().manual_seed(s) for s in seeds],
            schedule=schedule,
            num_steps=_integer(num_steps, "num_steps", 1, MAX_STEPS),
            uncertainty=uncertainty,
            block_size=self.preset.dit.block_size if block_size is None else _integer(block_size, "block_size", 1, 49),
            guidance_scale=_check_guidance(guidance_scale),
            window=window if window is None else _integer(window, "window", 1, 2**20),
            new_prompt=new_prompt,
            num_latents=None if num_frames is None else -(-num_frames // 4),
            lasts=0 if lasts is None else max(1, latents_before(lasts)),
        )
        return MotionStream(latents, self.decode, single, num_frames)

    @torch.no_grad()
    def _denoiser(self, prompts: list[str], valid: Tensor, scale: float, tell_length: bool) -> Denoise:
        batch, num_latents = valid.shape
        words = self._read(prompts)  # (B,S,E), (B,S)
        null = self._read([""])  # (1,2,E): what the model saw when its text was dropped
        mask = words.mask[:, None, :].expand(-1, num_latents, -1)  # (B,N,S): every latent sees the whole sentence
        null_mask = null.mask[:, None, :].expand(batch, num_latents, -1)
        null_words = null.embeddings.expand(batch, -1, -1)
        place = torch.arange(num_latents, dtype=torch.float32).expand(batch, -1)
        left = valid.sum(1, keepdim=True) - 1 - place if tell_length else torch.full_like(place, -1.0)
        clock = torch.stack([place, left], dim=-1)  # (B,N,2): all is one sentence
        denoise = guided(self.dit, words.embeddings, mask, null_words, null_mask, scale, valid, clock)
        return from_noise_prediction(denoise) if self.preset.dit.path == "ddpm" else denoise

    @torch.no_grad()
    def _read(self, sentences: list[str]) -> Words:
        return self.dit.read(self.text.encode(sentences))

    @torch.no_grad()
    def encode(self, features: np.ndarray | Tensor) -> Tensor:
        """Features (B,T,D), T a multiple of 4 -> normalised latents (B,N,C), the posterior means."""
        x = (torch.as_tensor(features, dtype=torch.float32) - self.stats["feature_mean"]) / self.stats["feature_std"]
        return (self.vae.encode(x)[0] - self.stats["latent_mean"]) / self.stats["latent_std"]

    @torch.no_grad()
    def decode(self, latents: Tensor, states: States | None = None) -> Tensor:
        """Normalised latents (B,N,C) -> features (B,4N,D); with `states` they continue those of the call before."""
        x = self.vae.decode(latents * self.stats["latent_std"] + self.stats["latent_mean"], states)
        return x * self.stats["feature_std"] + self.stats["feature_mean"]

    def reconstruct(self, features: np.ndarray) -> np.ndarray:
        """One clip (T,D) through the VAE and back, cut to a multiple of 4 frames. (T',D)"""
        whole = len(features) // 4 * 4
        return self.decode(self.encode(features[None, :whole]))[0].numpy()

    def _noise(self, generator: torch.Generator, num_latents: int) -> Tensor:
        longest = -(-MAX_FRAMES // 4)
        return torch.randn(longest, self.preset.dit.latent_dim, generator=generator)[:num_latents]

    def _check_prompt(self, prompt: object) -> None:
        if not isinstance(prompt, str):
            raise ValueError(f"a prompt must be a string, like 'a person walks', and {type(prompt).__name__} came")
        if not prompt.strip():
            raise ValueError("the prompt is empty: say what to do, like 'a person walks, then waves'")
        try:
            prompt.encode("utf-8")
        except UnicodeEncodeError as error:
            raise ValueError("the prompt holds bytes that are no text in this locale's encoding") from error
        encoding = self.text.tokenizer.encode(prompt)
        if encoding.overflowing:
            total = len(encoding.ids) + sum(len(rest.ids) for rest in encoding.overflowing)
            raise ValueError(
                f"the prompt is too long: about {total} word pieces, and the longest is {len(encoding.ids)}"
            )


def _as_list(value: object, name: str, expected: str) -> list:
    if not isinstance(value, (list, tuple)) or not value:
        what = "an empty list" if isinstance(value, (list, tuple)) else type(value).__name__
        raise ValueError(f"{name} must be {expected}, and {what} came")
    return list(value)


def _spread(value: object, count: int, name: str) -> list:
    """One value for all prompts, or a list with one for each."""
    if not isinstance(value, (list, tuple, np.ndarray)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name}: {count} prompts need one value or {count}, and {len(value)} came")
    return list(value)


def _integer(value: object, name: str, low: int, high: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, and {value!r} came")
    return int(value)


def _check_frames(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not MIN_FRAMES <= value <= MAX_FRAMES:
        raise ValueError(
            f"num_frames must be a whole number from {MIN_FRAMES} (0.2 s) to {MAX_FRAMES} (9.8 s, the longest), "
            f"and {value!r} came"
        )
    return int(value)


def _check_guidance(value: object) -> float:
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not 0 <= value <= MAX_GUIDANCE:
        raise ValueError(f"guidance_scale must be a number from 0 to {MAX_GUIDANCE:.0f} (1 is off), and {value!r} came")
    return float(value)
