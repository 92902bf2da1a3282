"""What a training will need, before it starts: parameters, memory and arithmetic of each stage.

Nothing is guessed by formula. Each stage's model takes one step with torch's fake tensors, which have shapes but no
numbers, while torch counts the products and we add up what the backward pass would have to keep. Products only: an
addition or a softmax costs time too, on small models even most of it. Sizes are those of float32 and of batches of the
longest clips; bfloat16 keeps about half of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from minicmdm.config import Preset
from minicmdm.data.programs import MAX_FRAMES
from minicmdm.data.skeleton import skeleton_of
from minicmdm.models.tmr import MotionTeacher
from minicmdm.models.vae import MACVAE, vae_loss
from minicmdm.systems import new_denoiser

WORDS, LEVELS = 20, 64  # of a sentence; different times in a batch
PER_WEIGHT = 4 * 5  # bytes: the weight, its gradient, two moments, the slow average


@dataclass(frozen=True)
class Estimate:
    """One stage: parameters, bytes in training, multiply-adds times two of a step, and steps."""

    stage: str
    parameters: int
    memory: int
    flops: int
    steps: int

    def __str__(self) -> str:
        return (
            f"{self.stage}: {self.parameters / 1e6:.2f} M parameters, {self.memory / 1e9:.2f} GB, "
            f"{self.flops / 1e9:.1f} GFLOPs a step, {self.flops * self.steps / 1e15:.3g} PFLOPs in {self.steps:,} steps"
        )


def estimate(plan: Preset, accumulate: int = 1) -> list[Estimate]:
    """What the stages tmr (its motion side), vae and dit of a preset need, with `accumulate` batches a step in turn."""
    cfg, group = plan.train, plan.vae.frames_per_latent
    latents = MAX_FRAMES // group * (2 if cfg.levels == "tiled" else 1)  # tiles.py: a clean copy of each beside it

    with FakeTensorMode():
        words_side = SimpleNamespace(cfg=plan.text)  # is not run
        teacher_dim = skeleton_of(plan.vae.input_dim).num_features
        teacher = MotionTeacher(plan.tmr, words_side, teacher_dim)
        vae, model = MACVAE(plan.vae), new_denoiser(plan)
        dit = getattr(model, "body", model)  # of MARDM and CDAMD the transformer; they have a head besides
        frames = torch.empty(cfg.tmr_batch, MAX_FRAMES, teacher_dim)
        crops = torch.empty(cfg.vae_batch, cfg.crop_frames // group * group, plan.vae.input_dim)
        z = torch.empty(cfg.dit_batch, latents, plan.dit.latent_dim)
        words = torch.empty(cfg.dit_batch, WORDS, plan.dit.dim)
        which = torch.empty(cfg.dit_batch, latents, dtype=torch.long)
        told = torch.empty(cfg.dit_batch, latents, dit.embed_clock.in_features) if plan.dit.clock else None

        def velocity() -> Tensor:
            modulations, read = dit.modulations(torch.empty(LEVELS)), dit.keys_values(words)
            mask, places = torch.zeros(latents, latents), torch.arange(latents)  # added to the scores
            seen = dit.evaluate(z, which, modulations, read, None, mask, places, told)
            if dit is model:
                return seen
            many = [x.repeat(plan.masked.repeats, 1, 1) for x in (z, seen)]  # at most: all latents masked
            return model.head(many[0], many[0][..., 0], many[1])

        return [
            _measure("tmr", teacher, lambda: teacher.frames(frames), cfg.tmr_steps, accumulate),
            _measure("vae", vae, lambda: vae_loss(vae(crops), crops, cfg).total, cfg.vae_steps, accumulate),
            _measure("dit", model, velocity, cfg.dit_steps, accumulate),
        ]


def _measure(stage: str, model: nn.Module, run: Callable[[], Tensor], steps: int, accumulate: int) -> Estimate:
    kept: dict[int, Tensor] = {}  # by storage: a tensor that two operations keep is there once
    own = {weight.untyped_storage()._cdata for weight in model.parameters()}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage()._cdata] = tensor
        return tensor

    with FlopCounterMode(display=False) as counter:
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            value = run().sum()
        value.backward()
    parameters = sum(weight.numel() for weight in model.parameters())
    activations = sum(x.untyped_storage().nbytes() for where, x in kept.items() if where not in own)
    return Estimate(
        stage, parameters, PER_WEIGHT * parameters + activations, accumulate * counter.get_total_flops(), steps
    )
