"""Studies of the models: many small ones, trained alike but for one thing, three seeds each.

    vae        a VAE that looks ahead, a causal one, a causal one aligned with the teacher (CMDM Table 4, first rows)
    masks      who sees whom among the latents in flight, and which levels they have in training
    objective  the paper's noise prediction (Eqs 7-10, Alg. 1) against the release's velocity
    sampling   steps K and stagger L (CMDM Table 4, last rows), on the causal models that "masks" trained
    grid       CMDM's cell and FloodDiffusion's, and the two between them: who sees whom x which levels training shows
    guidance   the shipped systems at several guidance scales, on validation prompts

`python -m minicmdm.evaluation.studies NAME` runs them.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from minicmdm.config import Preset, preset
from minicmdm.data.dataset import toy_dataset
from minicmdm.data.oracle import read_motion
from minicmdm.evaluation.evaluators import load_bench
from minicmdm.evaluation.horizon import timelines
from minicmdm.evaluation.metrics import segment_accuracy
from minicmdm.evaluation.protocols import reconstruction, text_to_motion
from minicmdm.pipeline import ASSETS, SHIPPED, MotionPipeline

PROMPTS = 512  # of the 1,024: half the time, and intervals come from seeds
FEW = 256  # where a row takes minutes
FEWEST = 128  # and where there is no cache, since the mask looks ahead
SEEDS = (0, 1, 2)
TUNING, SCALES = 128, (1.0, 2.0, 3.0, 4.5)  # validation prompts, and the guidance scales they are asked at
KEYS = ("oracle_accuracy", "r_at_1", "r_at_3", "fid", "skating_ratio")
Row = dict[str, str | float]
Rows = Iterator[tuple[Row, Callable[[], Row]]]


def micro(scratch: Path, name: str, plan: Preset, seed: int, vae_from: Path | None = None) -> MotionPipeline:
    """Train the micro preset on the shipped teacher and, if given, the VAE of another run; or load what is there."""
    from minicmdm.training.stages import train

    out = scratch / f"{name}-{seed}"
    if not (out / "dit.safetensors").is_file():
        (out / "text").mkdir(parents=True, exist_ok=True)
        for file in ("tmr.safetensors", "text/tokenizer.json", "text/config.json", "text/model.safetensors"):
            shutil.copyfile(ASSETS / "toy" / file, out / file)
        if vae_from is None:
            train(plan, out, stage="vae", seed=seed, resume=True, progress=False)
        else:
            for file in ("vae.safetensors", "stats.safetensors"):
                shutil.copyfile(vae_from / file, out / file)
        train(plan, out, stage="dit", seed=seed, resume=True, progress=False)
    return MotionPipeline.from_pretrained(out)


def shipped_vae(plan: Preset) -> Preset:
    """The plan with the shipped VAE's sizes: where the denoiser is the question, all share one VAE."""
    return replace(plan, vae=preset("toy").vae)


def answers(pipe: MotionPipeline, limit: int = PROMPTS, **ask) -> Row:
    """What one pass over the first prompts measures."""
    found = text_to_motion(pipe, load_bench(), repeats=1, limit=limit, progress=False, **ask)["metrics"]
    return {key: found[key]["mean"] for key in KEYS}


def vae_rows(scratch: Path) -> Rows:
    """CMDM Table 4, first rows: a VAE that looks ahead, a causal one, a causal one aligned with the teacher."""
    plan = preset("micro")
    for seed in SEEDS:
        for name, causal, weight in (("VAE", False, 0.0), ("C-VAE", True, 0.0), ("MAC-VAE", True, 0.1)):
            own = replace(plan, vae=replace(plan.vae, causal=causal), train=replace(plan.train, align_weight=weight))

            def measure(name=name, own=own, seed=seed) -> Row:
                pipe = micro(scratch, name, own, seed)
                back = reconstruction(pipe, load_bench(), limit=PROMPTS, progress=False)["metrics"]
                return answers(pipe) | {"mpjpe_mm": back["mpjpe_mm"]["mean"]}

            yield {"model": name, "seed": seed}, measure


def mask_rows(scratch: Path) -> Rows:
    """The paper's causal mask and our window, with the paper's independent levels and with those FSS will present."""
    plan = shipped_vae(preset("micro"))
    for seed in SEEDS:
        for attention in ("causal", "window"):
            for levels in ("random", "staircase"):
                dit, train = replace(plan.dit, attention=attention), replace(plan.train, levels=levels)
                own = replace(plan, dit=dit, train=train)

                def measure(own=own, name=f"{attention}-{levels}", seed=seed) -> Row:
                    return answers(micro(scratch, name, own, seed, ASSETS / "toy"))

                yield {"attention": attention, "levels": levels, "seed": seed}, measure


def objective_rows(scratch: Path) -> Rows:
    """Velocity with Euler steps, as released; noise with ancestral steps, as printed; and its deterministic DDIM."""
    plan = shipped_vae(preset("micro"))
    for seed in SEEDS:
        for path, solver in (("flow", "euler"), ("ddpm", "ddpm"), ("ddpm", "ddim")):
            own = replace(plan, dit=replace(plan.dit, path=path))
            name = "causal-random" if path == "flow" else path  # the same model as in `masks`

            def measure(own=own, name=name, seed=seed, solver=solver) -> Row:
                return answers(micro(scratch, name, own, seed, ASSETS / "toy"), solver=solver)

            yield {"path": path, "solver": solver, "seed": seed}, measure


def sampling_rows(scratch: Path) -> Rows:
    """CMDM Table 4, last rows: K of 20 and 50, L from 1 to 10; L = K is autoregressive ("w/o FSS"), and exact.

    Beside them all latents in step ("full"), on the same models; the paper's full-sequence row is another training.
    """
    settings = [("full", 20, 0), *(("fss", steps, wait) for steps in (20, 50) for wait in (1, 2, 5, 10))]
    settings += [("autoregressive", 20, 20)]
    plan = shipped_vae(preset("micro"))
    for seed in SEEDS:
        for schedule, steps, wait in settings:

            def measure(seed=seed, schedule=schedule, steps=steps, wait=wait) -> Row:
                pipe = micro(scratch, "causal-random", plan, seed, ASSETS / "toy")
                ask, start = dict(schedule=schedule, num_steps=steps, uncertainty=wait), time.process_time()
                row = answers(pipe, FEW, **ask) | {"seconds": time.process_time() - start}
                if schedule == "full":  # has no stream and so no seams: all is sampled at once
                    return row | {"transition_fid": float("nan"), "auj": float("nan")}
                seams = timelines(pipe, load_bench(), "long", repeats=1, progress=False, **ask)["metrics"]
                return row | {key: seams[key]["mean"] for key in ("transition_fid", "auj")}

            yield {"schedule": schedule, "K": steps, "L": wait, "seed": seed}, measure


def grid_rows(scratch: Path) -> Rows:
    """Attention x training levels x position x length of training; sampled by a triangle of 5 latents, and one by one.

    CMDM reports that causal x random works (FID 0.068), FloodDiffusion that bidirectional x triangle does (0.057) and
    that the other two cells do not (3.377 and 3.883). Rotary positions know distances only; "clock" tells a latent
    where it is as well. A triangle teaches few latents of a clip: at the shorter length the window mask is there too,
    with one triangle a clip and with all of them at once (tiles.py: as many steps, each twice the work).
    """
    plan = shipped_vae(preset("micro"))
    whole = plan.train.dit_steps
    cells = [(attention, levels) for attention in ("causal", "bidirectional") for levels in ("random", "triangle")]
    more = [("window", "tiled"), ("window", "triangle")]
    for position, steps in (("clock", whole), ("clock", whole // 2), ("rotary", whole // 2)):
        for seed in SEEDS:
            for attention, levels in cells + more * (position == "clock" and steps < whole):
                dit = replace(plan.dit, attention=attention, clock=position == "clock")
                own = replace(plan, dit=dit, train=replace(plan.train, levels=levels, dit_steps=steps))
                name = f"{attention}-{levels}" + "-rotary" * (position == "rotary") + "-half" * (steps < whole)

                def measure(own=own, name=name, seed=seed) -> Row:
                    pipe = micro(scratch, name, own, seed, ASSETS / "toy")
                    row = answers(pipe, FEWEST, schedule="triangular", num_steps=20, uncertainty=4)
                    alone = answers(pipe, FEWEST, schedule="autoregressive", num_steps=10)
                    return row | {f"{key}_one_by_one": alone[key] for key in ("oracle_accuracy", "fid")}

                kind = {"attention": attention, "levels": levels, "position": position, "steps": steps}
                yield {**kind, "seed": seed}, measure


def guidance_rows(scratch: Path) -> Rows:
    """Which guidance scale is best for each shipped system, on prompts of the validation set: equal tuning for all."""
    clips = toy_dataset("val", TUNING).clips
    prompts, frames = [clip.captions[0] for clip in clips], [len(clip.features) for clip in clips]
    for name in SHIPPED:
        for scale in SCALES:

            def measure(name=name, scale=scale) -> Row:
                pipe = MotionPipeline.from_pretrained(name)
                made = pipe(prompts, frames, seed=list(range(len(clips))), guidance_scale=scale)
                found = [tuple(read_motion(motion.joints)) for motion in made]
                return {"oracle_accuracy": segment_accuracy([clip.program for clip in clips], found)}

            yield {"system": name, "guidance_scale": scale}, measure
