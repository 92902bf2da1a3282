"""The two stages of CMDM's training in this library: first the causal VAE, then text encoder and Causal-DiT together.

    features --crops--> MAC-VAE          (stage "vae": learn the latents)
    latents  --levels, words--> CausalDiT (stage "dit": learn to denoise them, each latent at its own level)

Between them every clip is encoded once, and the latents' mean and std are measured, because a denoiser wants numbers of
unit size and an encoder writes them as it likes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import minicmdm
from minicmdm.config import Preset, preset
from minicmdm.data.dataset import MotionDataset, cached_toy_folder, load_dataset, toy_dataset
from minicmdm.data.features import features_to_joints
from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import TextEncoder
from minicmdm.models.vae import MACVAE, vae_loss
from minicmdm.training import checkpoints
from minicmdm.training.batches import LatentSet, crop_features, draw_batch, encode_dataset, words_per_latent
from minicmdm.training.loop import LoopConfig, LoopResult, fit, step_key

STAGES = ("vae", "dit", "all")
Say = Callable[[str], None]


def train(
    preset_name: str,
    out: str | Path,
    stage: str = "all",
    *,
    resume: bool = False,
    fast: bool = False,
    data: str | Path | None = None,
    seed: int | None = None,
    progress: bool = True,
    command: str = "",
    say: Say = lambda line: None,
) -> Path:
    """Train a preset and leave a checkpoint in the folder `out` (made if missing); return it.

    `data` is a folder in HumanML3D's layout; without it the toy world is synthesised. `fast` is a smoke run of seconds.
    Raises ValueError for an unknown preset or stage, FileExistsError where a run is there already and `resume` is off.
    """
    plan = preset(preset_name)
    if stage not in STAGES:
        raise ValueError(f"unknown stage {stage!r}: expected one of {', '.join(STAGES)}")
    plan = replace(plan, train=replace(plan.train, seed=plan.train.seed if seed is None else seed))
    if fast:
        small = dict(vae_steps=30, vae_batch=8, vae_warmup=5, dit_steps=30, dit_batch=8, dit_warmup=5)
        plan = replace(plan, train=replace(plan.train, **small))
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out {out} is a file: training writes a folder")
    wanted = [s for s in ("vae", "dit") if stage in (s, "all")]
    for name in wanted:
        if (out / f"state_{name}.safetensors").exists() and not resume:
            raise FileExistsError(
                f"{out} holds a run of stage {name} already: go on with --resume, or choose another --out"
            )
    if wanted == ["dit"] and not (out / "vae.safetensors").is_file():
        raise FileNotFoundError(f"{out} holds no vae.safetensors: stage dit needs stage vae before it")
    out.mkdir(parents=True, exist_ok=True)

    say("reading the data")
    train_set, val_set = _datasets(data, fast, progress)
    say(f"{len(train_set.clips)} clips to train on, {len(val_set.clips)} to validate on")
    facts = _old_facts(out)
    facts |= {
        "version": minicmdm.__version__,
        "torch": torch.__version__,
        "seed": plan.train.seed,
        "data": {"fingerprint": train_set.fingerprint, "clips": len(train_set.clips)},
        "command": command,
        "fast": fast,
    }
    for name in wanted:
        run = train_vae if name == "vae" else train_dit
        result, parameters = run(plan, train_set, val_set, out, resume=resume, progress=progress)
        facts["metrics"] |= result.metrics
        facts["seconds"] |= {name: round(result.seconds, 1)}
        facts["parameters"] |= parameters
        facts["made"] = time.strftime("%Y-%m-%d", time.gmtime())
        checkpoints.write_card(out, plan, facts)
        say(f"stage {name}: {result.seconds:.0f} s, " + ", ".join(f"{k} {v:.4g}" for k, v in result.metrics.items()))
    return out


def _datasets(data: str | Path | None, fast: bool, progress: bool) -> tuple[MotionDataset, MotionDataset]:
    if fast and data is None:
        return toy_dataset("train", count=48), toy_dataset("val", count=8)
    folder = cached_toy_folder(progress) if data is None else data
    return load_dataset(folder, "train"), load_dataset(folder, "val")


def _old_facts(out: Path) -> dict:
    facts = checkpoints.read_card(out) if (out / "card.json").is_file() else {}
    return {key: dict(facts.get(key, {})) for key in ("metrics", "seconds", "parameters")}


def _parameters(**modules: nn.Module) -> dict[str, int]:
    return {name: sum(weight.numel() for weight in module.parameters()) for name, module in modules.items()}


def train_vae(
    plan: Preset, train_set: MotionDataset, val_set: MotionDataset, out: Path, *, resume: bool, progress: bool
) -> tuple[LoopResult, dict[str, int]]:
    """Stage 1: learn the causal VAE on crops, then measure the latents and write vae and stats."""
    cfg = plan.train
    with torch.random.fork_rng(devices=[]):  # initial weights by the seed, and the caller's generator as it was
        torch.manual_seed(step_key(cfg.seed, -1))
        models = nn.ModuleDict({"vae": MACVAE(plan.vae)})

    def loss(models: nn.ModuleDict, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        x = crop_features(train_set, cfg.vae_batch, cfg.crop_frames, generator)  # (B,T,D)
        with torch.autocast("cpu", torch.bfloat16, enabled=cfg.bfloat16):
            output = models["vae"](x, generator)
        terms = vae_loss(output, x, cfg)
        return terms.total, {"recon": terms.recon.item(), "root": terms.root.item(), "kl": terms.kl.item()}

    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        return {"mpjpe_mm": reconstruction_mpjpe(ema["vae"], train_set, val_set, count=64)}

    config = _loop_config(plan, cfg.vae_steps, cfg.vae_lr, cfg.vae_warmup)
    identity = {"preset": plan.to_dict(), "data": train_set.fingerprint}
    result = fit("vae", models, loss, validate, config, out, identity=identity, resume=resume, progress=progress)
    vae = result.ema["vae"]
    latents = encode_dataset(vae, train_set)
    stats = {
        "feature_mean": torch.from_numpy(train_set.mean),
        "feature_std": torch.from_numpy(train_set.std),
        "latent_mean": latents.shift,
        "latent_std": latents.scale,
    }
    checkpoints.save_vae(out, vae, stats)
    return result, _parameters(vae=vae)


def train_dit(
    plan: Preset, train_set: MotionDataset, val_set: MotionDataset, out: Path, *, resume: bool, progress: bool
) -> tuple[LoopResult, dict[str, int]]:
    """Stage 2: diffusion forcing on the cached latents; text encoder and DiT learn together."""
    cfg = plan.train
    vae, stats = checkpoints.load_vae(out, plan)
    shift_scale = stats["latent_mean"], stats["latent_std"]
    latents = encode_dataset(vae, train_set, shift_scale)
    val_latents = encode_dataset(vae, val_set, shift_scale)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_key(cfg.seed, -2))
        text = _text_encoder(plan, train_set, out, resume)
        models = nn.ModuleDict({"text": text, "dit": CausalDiT(plan.dit)})

    def loss(models: nn.ModuleDict, step: int, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        return denoising_loss(models, latents, plan, cfg.dit_batch, cfg.text_drop, generator), {}

    @torch.no_grad()
    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        losses = []
        for key in range(4):  # the same batches and the same noise every time
            generator = torch.Generator().manual_seed(key)
            losses.append(denoising_loss(ema, val_latents, plan, 64, 0.0, generator).item())
        return {"val_loss": float(np.mean(losses))}

    config = _loop_config(plan, cfg.dit_steps, cfg.dit_lr, cfg.dit_warmup)
    vae_sum = checkpoints.checksum(out / "vae.safetensors")
    identity = {"preset": plan.to_dict(), "data": train_set.fingerprint, "vae": vae_sum}
    result = fit("dit", models, loss, validate, config, out, identity=identity, resume=resume, progress=progress)
    checkpoints.save_denoiser(out, result.ema["dit"], result.ema["text"])
    return result, _parameters(dit=result.ema["dit"], text=result.ema["text"])


def denoising_loss(
    models: nn.ModuleDict, latents: LatentSet, plan: Preset, count: int, drop: float, generator: torch.Generator
) -> Tensor:
    """Draw a batch, let every latent see its words, and ask for the velocity at one noise level per latent."""
    batch = draw_batch(latents, count, drop, generator)
    with torch.autocast("cpu", torch.bfloat16, enabled=plan.train.bfloat16):
        encoded = models["text"].encode(batch.sentences)  # each different sentence once
        words, mask = words_per_latent(encoded, batch.choice, batch.owner)  # (B,S,E), (B,N,S)
        return diffusion_forcing_loss(
            models["dit"], batch.z, words, mask, batch.valid, plan.dit.block_size, generator, batch.clock
        )


def _text_encoder(plan: Preset, train_set: MotionDataset, out: Path, resume: bool) -> TextEncoder:
    """The preset's text encoder from its folder, or a new one with a vocabulary learnt from the captions.

    It is written down at once, so that a resumed run goes on with the very vocabulary it began with.
    """
    if resume and (out / "state_dit.safetensors").is_file():
        return TextEncoder.load(out / "text", plan.text)
    if plan.text.path is not None:
        text = TextEncoder.load(plan.text.path, plan.text)
    else:
        captions = {caption for clip in train_set.clips for caption in clip.captions}
        captions |= {sentence for clip in train_set.clips for _, _, sentence in clip.labels}
        text = TextEncoder.from_captions(sorted(captions), plan.text)
    checkpoints.save_text(out, text)
    return text


def _loop_config(plan: Preset, steps: int, lr: float, warmup: int) -> LoopConfig:
    every = max(1, min(500, steps // 4))
    return LoopConfig(
        steps=steps,
        lr=lr,
        warmup=warmup,
        betas=plan.train.betas,
        weight_decay=plan.train.weight_decay,
        grad_clip=plan.train.grad_clip,
        ema=plan.train.ema,
        seed=plan.train.seed,
        log_every=max(1, min(20, steps // 4)),
        validate_every=every,
        save_every=every,
    )


@torch.no_grad()
def reconstruction_mpjpe(
    vae: MACVAE, train_set: MotionDataset, val_set: MotionDataset, count: int | None = None
) -> float:
    """Mean joint distance between clips and their reconstruction (posterior means), pelvis on pelvis, in mm.

    `train_set` gives the normalisation. The mean is over all frames and joints of the first `count` clips.
    """
    mean, std = torch.from_numpy(train_set.mean), torch.from_numpy(train_set.std)
    total, frames = 0.0, 0
    for clip in val_set.clips[:count]:
        length = len(clip.features) // 4 * 4
        x = torch.from_numpy(clip.features[:length])
        recon = vae.decode(vae.encode(((x - mean) / std)[None])[0])[0] * std + mean  # (T,D)
        truth, guess = features_to_joints(clip.features[:length]), features_to_joints(recon.numpy())  # (T,22,3)
        total += pelvis_distance(truth, guess).sum()
        frames += length
    return float(1000 * total / frames)


def pelvis_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Per frame, the mean joint distance in metres after moving pelvis onto pelvis. (T,22,3) twice -> (T,)."""
    apart = (a - a[:, :1]) - (b - b[:, :1])
    return np.linalg.norm(apart, axis=-1).mean(-1)
