"""What the denoiser stands on: the teacher with its text encoder (stage "tmr"), and the VAE it aligns (stage "vae").

    captions + features --contrast--> Part-TMR: frame features and word vectors that mean the same thing
    features --crops--> MAC-VAE, whose latents are pulled towards the teacher's frames (CMDM Eqs 2-6)

Both write what comes after them needs: the text encoder, frozen from here on, and the statistics of features and
latents.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from minicmdm.alignment import adaptive_weight, alignment_loss, group_mean
from minicmdm.config import Preset
from minicmdm.data.dataset import MotionDataset
from minicmdm.data.features import features_to_joints
from minicmdm.evaluation.metrics import mpjpe, r_precision
from minicmdm.models.text import TextEncoder, find_encoder
from minicmdm.models.tmr import MotionTeacher, contrastive_loss
from minicmdm.models.vae import MACVAE, vae_loss
from minicmdm.models.wordcache import WordCache
from minicmdm.training import checkpoints
from minicmdm.training.batches import crop_features, draw_captioned, encode_dataset, said
from minicmdm.training.distributed import ALONE, Team
from minicmdm.training.loop import LoopResult, fit, loop_config, step_key


def train_teacher(
    plan: Preset,
    train_set: MotionDataset,
    val_set: MotionDataset,
    out: Path,
    *,
    resume: bool,
    progress: bool,
    team: Team = ALONE,
) -> LoopResult:
    """Learn Part-TMR and the text encoder together by contrast; write tmr.safetensors and text/.

    A pretrained encoder that is to stay as it is (a path, and `frozen`) is read once: the motion side alone learns, and
    the linear map of the words.
    """
    cfg = plan.train
    with torch.random.fork_rng(devices=[]):  # initial weights by the seed, and the caller's generator as it was
        torch.manual_seed(step_key(cfg.seed, -3))
        again = resume and (out / "state_tmr.safetensors").is_file()
        text = new_text_encoder(plan, train_set, out / "text" if again else None)
        read = text
        if text.cfg.frozen:
            sentences = {"", *said(train_set), *said(val_set)}  # the denoiser's list: what is kept on disk serves both
            read = WordCache(text.to(team.device), sentences, progress=progress and team.first)
        models = nn.ModuleDict({"tmr": MotionTeacher(plan.tmr, read, len(train_set.mean))})
    if not again and team.first:  # at once, so that a resumed run goes on with the very vocabulary it began with
        checkpoints.save_text(out, text)

    def draw(generator: torch.Generator) -> tuple[Tensor, Tensor, list[str], Tensor]:
        return draw_captioned(train_set, cfg.tmr_batch, generator)

    def loss(models: nn.ModuleDict, batch: tuple, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        x, valid, captions, same = batch
        teacher, x, valid, same = models["tmr"], x.to(team.device), valid.to(team.device), same.to(team.device)
        with torch.autocast(team.device.type, torch.bfloat16, enabled=cfg.bfloat16):
            motion, words = teacher.motion(x, valid), teacher.sentences(captions)  # (B,E) each
        value = contrastive_loss(teacher.similarity(motion, words), same)
        return value, {"scale": teacher.log_scale.exp().item()}

    @torch.no_grad()
    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        return {"val_r_at_1": float(teacher_retrieval(ema["tmr"], train_set, val_set)[0])}

    config = loop_config(plan, cfg.tmr_steps, cfg.tmr_lr, cfg.tmr_warmup)
    identity = {"preset": plan.to_dict(), "data": train_set.fingerprint}
    how = {"identity": identity, "resume": resume, "progress": progress, "team": team, "draw": draw}
    result = fit("tmr", models, loss, validate, config, out, **how)
    if team.first:
        checkpoints.save_teacher(out, result.ema["tmr"])
    return result


def new_text_encoder(plan: Preset, train_set: MotionDataset, folder: Path | None = None) -> TextEncoder:
    """The encoder read from `folder` or the preset's path, or a new one with the captions' own vocabulary.

    It may learn, but for one from a path that is `frozen`.
    """
    cfg = plan.text if plan.text.path is not None else replace(plan.text, frozen=False)
    if folder is not None or plan.text.path is not None:
        return TextEncoder.load(folder or find_encoder(plan.text.path), cfg)
    return TextEncoder.from_captions(sorted(said(train_set)), cfg)


@torch.no_grad()
def teacher_retrieval(teacher: MotionTeacher, train_set: MotionDataset, clips: MotionDataset) -> np.ndarray:
    """R@1, 2, 3 of the teacher on `clips`, in pools of 32 with first captions; `train_set` normalises. (3,)"""
    device = teacher.log_scale.device
    motions = [teacher.motion(normalised(train_set, clip.features)[None].to(device))[0] for clip in clips.clips]
    words = torch.cat([teacher.sentences([clip.captions[0]]) for clip in clips.clips])  # (N,E)
    unit = [nn.functional.normalize(x, dim=-1).cpu().double().numpy() for x in (words, torch.stack(motions))]
    return r_precision(*unit, pool=min(32, len(clips)))


def normalised(train_set: MotionDataset, features: np.ndarray) -> Tensor:
    """Features as the models read them: the training set's mean taken off, divided by its std. (T,D)"""
    return torch.from_numpy((features - train_set.mean) / train_set.std).float()


def train_vae(
    plan: Preset,
    train_set: MotionDataset,
    val_set: MotionDataset,
    out: Path,
    *,
    resume: bool,
    progress: bool,
    team: Team = ALONE,
) -> LoopResult:
    """Learn the causal VAE on crops, aligned with the teacher; then measure the latents, write vae and stats."""
    cfg = plan.train
    aligned = cfg.align_weight > 0
    guides = teacher_frames(checkpoints.load_teacher(out, plan).to(team.device), train_set) if aligned else None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_key(cfg.seed, -1))
        models = nn.ModuleDict({"vae": MACVAE(plan.vae)})
        if aligned:  # W of CMDM Eq. 4; only training needs it
            models["align"] = nn.Linear(plan.vae.latent_dim, plan.tmr.embed_dim, bias=False)

    def draw(generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
        return crop_features(train_set, cfg.vae_batch, cfg.crop_frames, generator, guides)  # (B,T,D), (B,T,E)

    def loss(models: nn.ModuleDict, batch: tuple, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        x, guide = batch
        x, guide = x.to(team.device), None if guide is None else guide.to(team.device)
        with torch.autocast(team.device.type, torch.bfloat16, enabled=cfg.bfloat16):
            output = models["vae"](x, generator)
        terms = vae_loss(output, x, cfg)
        numbers = {"recon": terms.recon.item(), "root": terms.root.item(), "kl": terms.kl.item()}
        if not aligned:
            return terms.total, numbers
        z = output.z.float()
        target = group_mean(guide, plan.vae.frames_per_latent)  # (B,T,E) -> (B,N,E)
        pull = alignment_loss(z, models["align"](z), target, cfg.matrix_of)
        weight = adaptive_weight(terms.recon, pull, models["vae"].encoder[-1].conv.weight)
        numbers |= {"align": pull.item(), "lambda": weight.item()}
        return terms.total + cfg.align_weight * weight * pull, numbers

    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        return {"mpjpe_mm": reconstruction_mpjpe(ema["vae"], train_set, val_set, count=64)}

    config = loop_config(plan, cfg.vae_steps, cfg.vae_lr, cfg.vae_warmup)
    identity = {"preset": plan.to_dict(), "data": train_set.fingerprint}
    if aligned:
        identity["teacher"] = checkpoints.checksum(out / "tmr.safetensors")
    how = {"identity": identity, "resume": resume, "progress": progress, "team": team, "draw": draw}
    result = fit("vae", models, loss, validate, config, out, **how)
    vae = result.ema["vae"]
    latents = encode_dataset(vae, train_set)
    stats = {
        "feature_mean": torch.from_numpy(train_set.mean),
        "feature_std": torch.from_numpy(train_set.std),
        "latent_mean": latents.shift,
        "latent_std": latents.scale,
    }
    if team.first:
        checkpoints.save_vae(out, vae, stats)
    return result


@torch.no_grad()
def teacher_frames(teacher: MotionTeacher, data: MotionDataset) -> list[Tensor]:
    """The teacher's features of every frame of every clip, seen in its whole context: one (T,E) a clip.

    Computed once: the teacher is frozen, and a crop's frames mean what they mean in their clip.
    """
    device, out = teacher.log_scale.device, [None] * len(data.clips)
    order = sorted(range(len(out)), key=lambda i: len(data.clips[i].features))
    for first in range(0, len(order), 64):
        chosen = order[first : first + 64]
        clips = [normalised(data, data.clips[i].features).to(device) for i in chosen]
        lengths = torch.tensor([len(x) for x in clips], device=device)
        valid = torch.arange(int(lengths.max()), device=device) < lengths[:, None]  # (B,T)
        frames = teacher.frames(nn.utils.rnn.pad_sequence(clips, batch_first=True), valid)  # (B,T,E)
        for i, features, length in zip(chosen, frames, lengths):
            out[i] = features[:length].cpu().clone()
    return out


@torch.no_grad()
def reconstruction_mpjpe(
    vae: MACVAE, train_set: MotionDataset, val_set: MotionDataset, count: int | None = None
) -> float:
    """Mean joint distance between clips and their reconstruction (posterior means), pelvis on pelvis, in mm.

    `train_set` gives the normalisation. The mean is over all frames and joints of the first `count` clips.
    """
    device = next(vae.parameters(), torch.empty(0)).device
    mean, std = torch.from_numpy(train_set.mean).to(device), torch.from_numpy(train_set.std).to(device)
    total, frames = 0.0, 0
    for clip in val_set.clips[:count]:
        length = len(clip.features) // 4 * 4
        x = torch.from_numpy(clip.features[:length]).to(device)
        recon = vae.decode(vae.encode(((x - mean) / std)[None])[0])[0] * std + mean  # (T,D)
        truth, guess = features_to_joints(clip.features[:length]), features_to_joints(recon.cpu().numpy())  # (T,22,3)
        total += length * mpjpe(guess, truth)
        frames += length
    return float(1000 * total / frames)
