"""The last stage: diffusion forcing on cached latents, with the teacher's text encoder frozen (CMDM Alg. 1)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from minicmdm.config import Preset
from minicmdm.data.dataset import MotionDataset
from minicmdm.diffusion.forcing import diffusion_forcing_loss, draw_boundary, draw_staircase, draw_times
from minicmdm.diffusion.tiles import draw_tiles, in_tiles
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import TextEncoder, Words
from minicmdm.models.wordcache import WordCache
from minicmdm.systems import MASKED, MaskedTransformer, new_denoiser
from minicmdm.systems.flood import draw_triangle
from minicmdm.systems.mardm import masked_loss
from minicmdm.training import checkpoints
from minicmdm.training.batches import DenoiserBatch, draw_batch, encode_dataset, said, words_per_latent
from minicmdm.training.distributed import ALONE, Team
from minicmdm.training.loop import LoopResult, fit, loop_config, step_key


def train_dit(
    plan: Preset,
    train_set: MotionDataset,
    val_set: MotionDataset,
    out: Path,
    *,
    resume: bool,
    progress: bool,
    team: Team = ALONE,
) -> LoopResult:
    """Learn the denoiser: clips are encoded once, sentences once each, and every latent gets its own noise level."""
    cfg = plan.train
    vae, stats = checkpoints.load_vae(out, plan)
    vae.to(team.device)
    shift_scale = stats["latent_mean"], stats["latent_std"]
    latents = encode_dataset(vae, train_set, shift_scale)
    val_latents = encode_dataset(vae, val_set, shift_scale)
    text = TextEncoder.load(out / "text", plan.text).to(team.device)
    words = WordCache(text, {"", *said(train_set), *said(val_set)}, progress=progress and team.first)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_key(cfg.seed, -2))
        dit = new_denoiser(plan)
    if plan.system == "cdamd":
        dit.quantizer.fit(torch.cat(latents.means), torch.Generator().manual_seed(step_key(cfg.seed, -4)))
    if cfg.compile:  # the elementwise work between the matmuls, more than half of a step, becomes a few loops
        transformer = dit.body if plan.system in MASKED else dit
        head = [dit.head] if plan.system in MASKED else []
        for block in (*transformer.blocks, *transformer.word_blocks, *head):
            block.compile(dynamic=True)
    models = nn.ModuleDict({"dit": dit})

    def draw(generator: torch.Generator) -> DenoiserBatch:
        return draw_batch(latents, cfg.dit_batch, cfg.text_drop, generator)

    def loss(
        models: nn.ModuleDict, batch: DenoiserBatch, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, float]]:
        return denoising_loss(models["dit"], words, batch, plan, cfg.word_drop, generator), {}

    @torch.no_grad()
    def validate(ema: nn.ModuleDict) -> dict[str, float]:
        losses = []
        for key in range(4):  # the same batches and the same noise every time
            generator = torch.Generator().manual_seed(key)
            batch = draw_batch(val_latents, 64, 0.0, generator)
            losses.append(denoising_loss(ema["dit"], words, batch, plan, 0.0, generator).item())
        return {"val_loss": float(np.mean(losses))}

    config = loop_config(plan, cfg.dit_steps, cfg.dit_lr, cfg.dit_warmup, cfg.dit_muon)
    identity = {"preset": plan.to_dict(), "data": train_set.fingerprint}
    for name in ("vae.safetensors", "text/model.safetensors"):
        identity[name] = checkpoints.checksum(out / name)
    how = {"identity": identity, "resume": resume, "progress": progress, "team": team, "draw": draw}
    result = fit("dit", models, loss, validate, config, out, **how)
    if team.first:
        checkpoints.save_dit(out, result.ema["dit"])
    return result


def denoising_loss(
    dit: CausalDiT | MaskedTransformer,
    words: WordCache,
    batch: DenoiserBatch,
    plan: Preset,
    word_drop: float,
    generator: torch.Generator,
) -> Tensor:
    """Let every latent of a batch see its words, and ask for the velocity at one noise level per latent.

    `word_drop` says how often a word is hidden. All is drawn on the CPU, the same for every device, and then goes to
    the denoiser's.
    """
    block_size, committed, visible, tile = plan.dit.block_size, None, batch.valid, None
    if plan.system in MASKED:  # no levels: what is masked is drawn with the loss
        t = torch.zeros(batch.valid.shape)
    elif plan.train.levels == "staircase":
        t, committed, visible = draw_staircase(batch.valid, block_size, generator)
    elif plan.train.levels == "triangle":
        t, committed, visible = draw_triangle(batch.valid, plan.train.overlap, generator)
    elif plan.train.levels == "tiled":
        t, tile = draw_tiles(batch.valid, plan.train.overlap, generator)
    else:
        t = draw_times(*batch.valid.shape, block_size, generator, plan.train.time_power)
        if plan.dit.attention != "causal":  # who looks ahead must have seen motions whose rest still waits, hidden
            past, visible = draw_boundary(batch.valid, block_size, generator)
            committed = past if plan.dit.attention == "window" else None
    said = hide_words(words.encode(batch.sentences), word_drop, generator)  # each sentence once: (U,S1,E)
    device = next(dit.parameters()).device
    batch, said = batch.to(device), Words(said.embeddings.to(device), said.mask.to(device))
    t, visible = t.to(device), visible.to(device)
    committed = None if committed is None else committed.to(device)
    with torch.autocast(device.type, torch.bfloat16, enabled=plan.train.bfloat16):
        seen, mask = words_per_latent(dit.read(said), batch.choice, batch.owner)  # (B,S,E), (B,N,S)
        if plan.system in MASKED:
            return masked_loss(dit, batch.z, seen, mask, visible, batch.clock, generator)
        return diffusion_forcing_loss(
            dit if tile is None else in_tiles(dit, batch.z, tile.to(device)),
            batch.z,
            seen,
            mask,
            visible,
            generator=generator,
            clock=batch.clock,
            path=plan.dit.path,
            target=plan.dit.target,
            committed=committed,
            t=t,
        )


def hide_words(words: Words, share: float, generator: torch.Generator) -> Words:
    """Hide a share of the words of each sentence (U,S) from the denoiser, but never its marks [CLS] and [SEP].

    Captions say most things twice ("sits down on a chair"), and a model that always sees all of a phrase learns the
    phrase. One that has to do without some of its words should learn what each of them means (README).
    """
    if share == 0:
        return words
    place = torch.arange(words.mask.shape[1])
    inner = (place > 0) & (place < words.mask.sum(1, keepdim=True) - 1)  # (U,S)
    hidden = inner & (torch.rand(words.mask.shape, generator=generator) < share)
    return Words(words.embeddings, words.mask & ~hidden)
