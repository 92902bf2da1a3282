"""From a sentence to a motion: tokenise, sample latents under a schedule, decode, recover the joints.

    pipe = MotionPipeline.from_pretrained("toy")
    motion = pipe("a person walks, then waves the left hand", num_frames=120, seed=0)

A motion depends on its own prompt, length and seed, and never on what else is in its batch: each prompt has its own
generator, and the noise for the longest motion is drawn first and then cut. (Solvers that draw noise at every step
draw it for the longest of the batch, so there the company counts.) As the model is causal, a longer motion
of the same prompt and seed begins like the shorter one, unless the model is told how long it is to be (`tell_length`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import minicmdm
from minicmdm import asking
from minicmdm.data.features import features_to_joints
from minicmdm.data.skeleton import Skeleton, skeleton_of
from minicmdm.diffusion.sampling import Denoise, from_noise_prediction, guided, sample
from minicmdm.diffusion.schedules import schedule_matrix
from minicmdm.diffusion.streaming import LatentStream
from minicmdm.editing import kept
from minicmdm.live import USUAL, MotionStream, latents_before
from minicmdm.models.layers import States
from minicmdm.models.text import Words
from minicmdm.motion import Motion
from minicmdm.systems import MASKED
from minicmdm.systems.flood import to_velocity
from minicmdm.training import checkpoints

TOGETHER = 64  # how many motions are sampled in one batch
SHIPPED = ("toy", "flood", "mardm", "cdamd")
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
        """Load a shipped checkpoint by its name ("toy", or another system's), or any checkpoint by its folder.

        Raises FileNotFoundError or ValueError where there is none, or one that is cut short, changed or foreign.
        """
        if not str(name).strip():
            raise ValueError('the checkpoint name is empty: give "toy" or a folder made by `minicmdm train --out`')
        folder = Path(name)
        if str(name) in SHIPPED and not (folder / "card.json").is_file():
            folder = ASSETS / str(name)
        checkpoint = checkpoints.load_checkpoint(folder)
        if checkpoint.preset.system in MASKED:
            from minicmdm.systems.masked import MaskedPipeline  # which is a pipeline

            return MaskedPipeline(checkpoint)
        return cls(checkpoint)

    @property
    def skeleton(self) -> Skeleton:
        """The body that its training data had, with its frame rate."""
        return skeleton_of(self.preset.vae.input_dim)

    def sampling(self, schedule: str | None, num_steps: int | None, uncertainty: int | None) -> dict[str, str | int]:
        """The schedule, K and L of this system, but for what is given: for `pipe(...)`, `pipe.stream(...)`."""
        return asking.usual_sampling(self.preset.system, schedule, num_steps, uncertainty)

    def save_pretrained(self, folder: str | Path) -> Path:
        """Write the checkpoint (weights, text encoder, statistics, card) into a folder, made if missing."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        checkpoints.save_vae(folder, self.vae, self.stats)
        checkpoints.save_dit(folder, self.dit)
        checkpoints.save_text(folder, self.text)
        facts = {key: value for key, value in self.card.items() if key not in ("format", "preset", "files", "shared")}
        checkpoints.write_card(folder, self.preset, facts)
        return folder

    def __call__(
        self,
        prompt: str | Sequence[str],
        num_frames: int | Sequence[int] = 120,
        *,
        schedule: str | None = None,
        num_steps: int | None = None,
        uncertainty: int | None = None,
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
        prompts = [prompt] if single else asking.as_list(prompt, "prompt", "a string or a list of strings")
        for text in prompts:
            self._check_prompt(text)
        frames = [asking.check_frames(n) for n in asking.spread(num_frames, len(prompts), "num_frames")]
        seeds = [asking.integer(s, "seed", 0, 2**63 - 1) for s in asking.spread(seed, len(prompts), "seed")]
        ask = self._asked(schedule, num_steps, uncertainty, block_size, guidance_scale, solver, tell_length)
        motions: dict[int, Motion] = {}
        lengths = [-(-n // 4) for n in frames]  # latents: frames / 4, rounded up
        for chosen in asking.batches(lengths, TOGETHER, alike=self.preset.dit.attention == "window"):
            counts = [lengths[i] for i in chosen]
            luck = [torch.Generator().manual_seed(seeds[i]) for i in chosen]
            latents = self._latents([prompts[i] for i in chosen], counts, luck, ask)
            for i, count, one in zip(chosen, counts, latents):  # a VAE that looks ahead must not see padding
                motions[i] = self._motion(one[:count], frames[i], prompts[i])
        return motions[0] if single else [motions[i] for i in range(len(prompts))]

    def _asked(
        self, schedule, num_steps, uncertainty, block_size, guidance_scale, solver, tell_length=True
    ) -> asking.Asked:
        plan = self.sampling(schedule, num_steps, uncertainty)
        solver = solver or {"flow": "euler", "ddpm": "ddpm"}[self.preset.dit.path]
        block_size = self.preset.dit.block_size if block_size is None else block_size
        return asking.check_sampling(*plan.values(), block_size, guidance_scale, solver, tell_length)

    @torch.no_grad()
    def _latents(
        self,
        prompts: list[str],
        counts: list[int],
        luck: list[torch.Generator],
        ask: asking.Asked,
        prefix: Tensor | None = None,
    ) -> Tensor:
        """Sampled latents (B,N,C), N the greatest of `counts`, of which the first (B,P,C) may be given."""
        plan = dict(schedule=ask.schedule, num_steps=ask.num_steps, uncertainty=ask.uncertainty)
        plain = ask.solver == "euler" and ask.schedule != "trapezoid" and prefix is None
        # A stream knows no padding. Causal latents do not look at it, and under "window" there is none (asking.py).
        if plain and self.preset.dit.attention != "bidirectional" and self.preset.dit.target == "v":
            how = dict(block_size=ask.block_size, guidance_scale=ask.guidance_scale)
            how |= dict(num_latents=max(counts), lasts=counts if ask.tell_length else 0)
            return LatentStream(self.dit, self._read, self._read([""]), prompts, luck, **plan, **how).drain()
        given = 0 if prefix is None else prefix.shape[1]
        noise = torch.stack([self._noise(generator, max(counts)) for generator in luck])[:, given:]  # (B,N-P,C)
        valid = torch.arange(max(counts)) < torch.tensor(counts)[:, None]  # (B,N)
        matrix = schedule_matrix(max(counts) - given, ask.num_steps, ask.uncertainty, ask.block_size, ask.schedule)
        denoise = self._denoiser(prompts, valid, ask.guidance_scale, ask.tell_length)
        how = dict(solver=ask.solver, path=self.preset.dit.path, generator=luck)
        return sample(denoise, matrix, noise, prefix, **how)

    def _motion(self, latents: Tensor, frames: int, caption: str) -> Motion:
        features = self.decode(latents[None])[0, :frames].numpy()  # (T,D)
        return Motion(features_to_joints(features).astype(np.float32), features, caption, self.skeleton.fps)

    def edit(
        self,
        motion: Motion,
        given: str = "first_half",
        prompt: str | None = None,
        *,
        guidance_scale: float = 3.0,
        seed: int = 0,
    ) -> Motion:
        """Make a part of a motion anew, for a prompt or its own caption, and keep what is `given` of it.

        MARDM and CDAMD keep "first_half", "second_half", "ends" or "middle"; a model that starts at the beginning can
        go on from the "first_half" alone. Kept parts are encoded by themselves and come back as the autoencoder has
        them. Raises ValueError for anything that cannot be asked.
        """
        prompt = motion.caption if prompt is None else prompt
        self._check_prompt(prompt)
        ask = self._asked(None, None, None, None, guidance_scale, None)
        generator = torch.Generator().manual_seed(asking.integer(seed, "seed", 0, 2**63 - 1))
        z, keep = kept(self.encode, motion, given, self.preset.system)  # (1,N,C), (N,)
        return self._motion(self._fill(z, keep, prompt, generator, ask)[0], len(motion), prompt)

    def _fill(self, z: Tensor, keep: Tensor, prompt: str, generator: torch.Generator, ask: asking.Asked) -> Tensor:
        """The latents z (1,N,C) that are not to be kept, sampled. (1,N,C)"""
        given = int(keep.sum())
        if not keep[:given].all():
            raise ValueError('this model works from the beginning on: it can keep the "first_half", the others not')
        return self._latents([prompt], [len(keep)], [generator], ask, z[:, :given])

    def stream(
        self,
        prompt: str | Sequence[str],
        *,
        schedule: str | None = None,
        num_steps: int | None = None,
        uncertainty: int | None = None,
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
        if self.preset.dit.path != "flow" or self.preset.dit.target != "v":
            raise ValueError("this model predicts no velocity, along which a stream steps: generate motions instead")
        single = isinstance(prompt, str)
        prompts = [prompt] if single else asking.as_list(prompt, "prompt", "a string or a list of strings")
        seeds = [asking.integer(s, "seed", 0, 2**63 - 1) for s in asking.spread(seed, len(prompts), "seed")]
        plan = self.sampling(schedule, num_steps, uncertainty)
        num_frames = num_frames if num_frames is None else asking.integer(num_frames, "num_frames", 1, 2**31)
        lasts = lasts if lasts is None else asking.integer(lasts, "lasts", 1, 2**31)

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
            schedule=plan["schedule"],
            num_steps=asking.integer(plan["num_steps"], "num_steps", 1, asking.MAX_STEPS),
            uncertainty=plan["uncertainty"],
            block_size=self.preset.dit.block_size
            if block_size is None
            else asking.integer(block_size, "block_size", 1, 49),
            guidance_scale=asking.check_guidance(guidance_scale),
            window=window if window is None else asking.integer(window, "window", 1, 2**20),
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
        if self.preset.dit.path == "ddpm":
            return from_noise_prediction(denoise)
        target = self.preset.dit.target
        return denoise if target == "v" else lambda z_t, t: to_velocity(denoise(z_t, t), target, z_t, t)

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
        longest = -(-asking.MAX_FRAMES // 4)
        return torch.randn(longest, self.preset.dit.latent_dim, generator=generator)[:num_latents]

    def _check_prompt(self, prompt: object) -> None:
        asking.check_prompt(prompt, self.text.tokenizer)
