"""The four stages of training, in their order, and the one command that runs them.

    evaluator   judges that score generated motions; no other stage sees them
    tmr         the teacher and the text encoder, by contrast
    vae         the causal VAE, aligned with the teacher
    dit         the denoiser, on the VAE's latents and the teacher's words

Each stage leaves its part of the checkpoint in the folder, and the next one reads it there: a run may stop anywhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

import minicmdm
from minicmdm.config import Preset, preset
from minicmdm.data.dataset import MotionDataset, cached_toy_folder, toy_dataset
from minicmdm.data.folders import load_dataset
from minicmdm.evaluation.evaluators import train_bench
from minicmdm.models.text import find_encoder, with_encoder
from minicmdm.systems import seen_by
from minicmdm.training import checkpoints
from minicmdm.training.denoiser import train_dit
from minicmdm.training.distributed import Team
from minicmdm.training.estimate import estimate
from minicmdm.training.representation import train_teacher, train_vae

RUN = {"evaluator": train_bench, "tmr": train_teacher, "vae": train_vae, "dit": train_dit}
NEEDS = {"evaluator": (), "tmr": (), "vae": ("tmr.safetensors",), "dit": ("vae.safetensors", "text/model.safetensors")}
STAGES = (*RUN, "all")
FAST = {f"{name}_steps": 30 for name in RUN} | {f"{name}_batch": 8 for name in RUN}
FAST |= {f"{name}_warmup": 5 for name in RUN if name != "evaluator"}
Say = Callable[[str], None]


def _silent(line: str) -> None:
    pass


def train(
    preset_name: str | Preset,
    out: str | Path,
    stage: str = "all",
    *,
    system: str = "cmdm",
    resume: bool = False,
    fast: bool = False,
    data: str | Path | None = None,
    seed: int | None = None,
    compile: bool = False,
    bf16: bool = False,
    accumulate: int | None = None,
    device: str = "cpu",
    text: str | None = None,
    workers: int = 0,
    progress: bool = True,
    command: str = "",
    say: Say = _silent,
) -> Path:
    """Train a preset (a name, or a Preset of one's own) and leave a checkpoint in the folder `out`, made if missing.

    `system` is one of `config.SYSTEMS`; all go through the same stages.

    `data` is a folder in HumanML3D's layout; without it the toy world is synthesised. `fast` is a smoke run of seconds;
    `compile` makes the denoiser's steps shorter, where there is a C++ compiler; `bf16` computes in bfloat16.
    `accumulate`, `device`, `workers`: see distributed.py.
    `text` names a pretrained text encoder ("minilm", a folder, a hub name that is on this machine) that stays frozen.
    Raises ValueError for an unknown preset or stage, FileExistsError where a run is there already and `resume` is off.
    """
    plan = preset(preset_name, system) if isinstance(preset_name, str) else preset_name
    if stage not in STAGES:
        raise ValueError(f"unknown stage {stage!r}: expected one of {', '.join(STAGES)}")
    own = {"seed": plan.train.seed if seed is None else seed, "compile": compile or plan.train.compile}
    own["bfloat16"] = bf16 or plan.train.bfloat16
    plan = replace(plan, train=replace(plan.train, **own))
    if fast:
        plan = replace(plan, train=replace(plan.train, **FAST))
    if accumulate is not None:
        plan = replace(plan, train=replace(plan.train, accumulate=accumulate))
    if text is not None:
        plan = with_encoder(plan, text)
    elif plan.text.path is not None and stage in ("tmr", "all") and not resume:
        find_encoder(plan.text.path)  # said now, and not after the judges have been trained
    team = Team(device, together=True, workers=workers)
    team.share(plan.train.accumulate)
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out {out} is a file: training writes a folder")
    wanted = [name for name in RUN if stage in (name, "all")]
    for name in wanted:
        if (out / f"state_{name}.safetensors").exists() and not resume:
            raise FileExistsError(
                f"{out} holds a run of stage {name} already: go on with --resume, or choose another --out"
            )
    if stage != "all" and (missing := [file for file in NEEDS[stage] if not (out / file).is_file()]):
        raise FileNotFoundError(f"{out} holds no {missing[0]}: stage {stage} needs the stages before it")
    team.wait()
    if not team.first:
        say = _silent

    say("reading the data")
    train_set, val_set = _datasets(data, fast, progress)
    own_train = seen_by(plan.system, train_set)  # what is encoded: features, essential ones, or coordinates
    own_val = seen_by(plan.system, val_set, own_train)
    plan = replace(plan, vae=replace(plan.vae, input_dim=len(own_train.mean)))  # 263, or KIT-ML's 251, or fewer
    out.mkdir(parents=True, exist_ok=True)  # not sooner: what is wrong with the data leaves no folder behind
    say(f"{len(train_set.clips)} clips to train on, {len(val_set.clips)} to validate on")
    if progress and not fast:
        for line in estimate(plan, plan.train.accumulate):
            if line.stage in wanted:
                say(str(line))
    facts = _old_facts(out)
    facts |= {
        "version": minicmdm.__version__,
        "torch": torch.__version__,
        "seed": plan.train.seed,
        "data": {"fingerprint": train_set.fingerprint, "clips": len(train_set.clips)},
        "fast": fast,
    }
    for name in wanted:
        sets = (own_train, own_val) if name in ("vae", "dit") else (train_set, val_set)
        result = RUN[name](plan, *sets, out, resume=resume, progress=progress, team=team)
        facts["metrics"] |= result.metrics
        facts["seconds"] |= {name: round(result.seconds, 1)}
        facts["commands"] |= {name: command}
        facts["parameters"] |= {key: sum(w.numel() for w in part.parameters()) for key, part in result.ema.items()}
        facts["made"] = time.strftime("%Y-%m-%d", time.gmtime())
        if team.first:
            checkpoints.write_card(out, plan, facts)
        team.wait()  # the next stage reads what this one wrote
        say(f"stage {name}: {result.seconds:.0f} s, " + ", ".join(f"{k} {v:.4g}" for k, v in result.metrics.items()))
    return out


def _datasets(data: str | Path | None, fast: bool, progress: bool) -> tuple[MotionDataset, MotionDataset]:
    if fast and data is None:
        return toy_dataset("train", count=48), toy_dataset("val", count=8)
    folder = cached_toy_folder(progress) if data is None else data
    return load_dataset(folder, "train"), load_dataset(folder, "val")


def _old_facts(out: Path) -> dict:
    facts = checkpoints.read_card(out) if (out / "card.json").is_file() else {}
    groups = {key: facts.get(key) for key in ("metrics", "seconds", "commands", "parameters")}
    return {key: dict(group) if isinstance(group, dict) else {} for key, group in groups.items()}
