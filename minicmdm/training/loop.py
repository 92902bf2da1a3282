"""One plain training loop, used by every stage.

It is the loop of any textbook: draw a batch, compute the loss, step the optimiser, remember a slow average of the
weights (EMA), write down the losses, now and then validate and save. Two habits make it exact:

* Nothing random outlives a step. Each step's generator is keyed by (seed, step), so the batches and the noise of step
  1000 are the same whether the run got there in one go or was killed five times: no random state has to be saved.
* All that does outlive a step (weights, EMA, the optimiser's moments, the clock) is one safetensors file, replaced as a
  whole. On one thread a resumed run therefore ends in the very numbers of an unbroken one.
"""

from __future__ import annotations

import copy
import csv
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor, nn
from tqdm import tqdm

from minicmdm.config import Preset
from minicmdm.files import whole_file
from minicmdm.training.checkpoints import load_tensors, save_tensors
from minicmdm.training.distributed import ALONE, Team
from minicmdm.training.muon import Muon, inner_matrices


@dataclass(frozen=True)
class LoopConfig:
    """The numbers a loop needs, whatever it trains."""

    steps: int
    lr: float
    warmup: int = 200
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0
    grad_clip: float = 1.0
    ema: float = 0.999
    muon: float = 0.0  # Muon's learning rate for the matrices of transformer blocks; 0: AdamW for everything
    accumulate: int = 1  # micro-batches a step
    seed: int = 0
    log_every: int = 20
    validate_every: int = 500
    save_every: int = 500


def loop_config(plan: Preset, steps: int, lr: float, warmup: int, muon: float = 0.0) -> LoopConfig:
    """A stage's loop: what differs between the stages is given, the rest is the plan's."""
    cfg, every = plan.train, max(1, min(500, steps // 4))
    return LoopConfig(
        steps=steps,
        lr=lr,
        warmup=warmup,
        betas=cfg.betas,
        weight_decay=cfg.weight_decay,
        grad_clip=cfg.grad_clip,
        ema=cfg.ema,
        muon=muon,
        accumulate=cfg.accumulate,
        seed=cfg.seed,
        log_every=max(1, min(20, steps // 4)),
        validate_every=every,
        save_every=every,
    )


@dataclass
class LoopResult:
    """What a run leaves: the averaged weights, the last validation numbers, the seconds it took in all its lives."""

    ema: nn.ModuleDict
    metrics: dict[str, float]
    seconds: float


Draw = Callable[[torch.Generator], object]
Loss = Callable[[nn.ModuleDict, object, torch.Generator], tuple[Tensor, dict[str, float]]]
Validate = Callable[[nn.ModuleDict], dict[str, float]]


def step_key(seed: int, step: int) -> int:
    """Mix a seed and a step into one generator seed (splitmix64's finaliser: neighbours give unrelated streams)."""
    mask = (1 << 64) - 1
    key = (seed * 0x9E3779B97F4A7C15 + step + 1) & mask
    key = ((key ^ (key >> 30)) * 0xBF58476D1CE4E5B9) & mask
    key = ((key ^ (key >> 27)) * 0x94D049BB133111EB) & mask
    return (key ^ (key >> 31)) >> 1  # torch takes seeds below 2^63


def learning_rate(config: LoopConfig, step: int) -> float:
    """A straight line up for `warmup` steps, then half a cosine down to 2 % of the top."""
    if step < config.warmup:
        return config.lr * (step + 1) / config.warmup
    progress = (step - config.warmup) / max(1, config.steps - config.warmup)
    return config.lr * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))


def make_optimizers(models: nn.Module, config: LoopConfig) -> dict[str, torch.optim.Optimizer]:
    """AdamW for all weights that learn, or for what Muon leaves; their names are those of their state on disk."""
    matrices = inner_matrices(models) if config.muon else []
    inner = {id(weight) for weight in matrices}
    others = [weight for weight in models.parameters() if weight.requires_grad and id(weight) not in inner]
    how = {"betas": config.betas, "weight_decay": config.weight_decay, "fused": True}
    optimizers: dict[str, torch.optim.Optimizer] = {"adamw": torch.optim.AdamW(others, lr=config.lr, **how)}
    return optimizers | ({"muon": Muon(matrices, config.muon)} if matrices else {})


@torch.no_grad()
def update_ema(ema: nn.Module, model: nn.Module, decay: float, step: int) -> None:
    """Move the average towards the model: w <- decay w + (1 - decay) model. Early on the decay is smaller, so that
    the random initial weights are soon forgotten."""
    decay = min(decay, (1 + step) / (10 + step))
    averages, weights = list(ema.parameters()), list(model.parameters())
    torch._foreach_lerp_(averages, weights, 1 - decay)
    for average, value in zip(ema.buffers(), model.buffers(), strict=True):
        average.copy_(value)


def fit(
    name: str,
    models: nn.ModuleDict,
    loss: Loss,
    validate: Validate,
    config: LoopConfig,
    folder: Path,
    *,
    identity: Mapping[str, object],
    resume: bool = False,
    progress: bool = True,
    team: Team = ALONE,
    draw: Draw = lambda generator: None,
) -> LoopResult:
    """Train `models` on `loss` for `config.steps` steps, leaving state, CSV and picture of the losses in `folder`.

    `loss(models, batch, generator)` returns the scalar to descend and numbers to log, for the batch of
    `draw(generator)`, which a thread of `team` may have drawn ahead of time; `validate(ema)` returns numbers.
    `identity` (preset, seed, data) is stored with the state: a resume with another identity is refused with ValueError.
    The micro-batches of a step are shared by the processes of `team`; its first one alone validates and writes.
    """
    share = team.share(config.accumulate)
    models.to(team.device)
    state_file = folder / f"state_{name}.safetensors"
    table_file = folder / f"losses_{name}.csv"
    ema = copy.deepcopy(models).eval().requires_grad_(False)
    weights = [weight for weight in models.parameters() if weight.requires_grad]
    optimizers = make_optimizers(models, config)
    tops = {kind: optimizer.param_groups[0]["lr"] for kind, optimizer in optimizers.items()}
    start, seconds, table, metrics = 0, 0.0, [], {}
    if resume and state_file.is_file():
        start, seconds, table, metrics = _restore(state_file, models, ema, optimizers, identity)

    models.train()
    clock = time.perf_counter() - seconds
    quiet = not (progress and team.first)
    bar = tqdm(total=config.steps, initial=start, desc=f"train {name}", disable=quiet, mininterval=1.0)
    turns = (step * config.accumulate + part for step in range(start, config.steps) for part in share)
    drawn = team.ahead(lambda turn: _drawn(step_key(config.seed, turn), draw), turns)
    with bar:  # closed whatever happens, so that what is said next has a line of its own
        for step in range(start, config.steps):
            models.zero_grad(set_to_none=True)
            total = torch.zeros((), device=team.device)
            for key, batch, generator in islice(drawn, len(share)):
                with torch.random.fork_rng(devices=[]):  # dropout draws from the global generator: key it too
                    torch.manual_seed(key)
                    value, numbers = loss(models, batch, generator)
                (value / config.accumulate).backward()
                total += value.detach() / config.accumulate
            team.add_up([total, *(weight.grad for weight in weights if weight.grad is not None)])
            norm = nn.utils.clip_grad_norm_(weights, config.grad_clip)
            if not torch.isfinite(norm):
                raise ValueError(
                    f"training {name}: the gradient at step {step} is not finite; try a lower learning rate"
                )
            for kind, optimizer in optimizers.items():
                optimizer.param_groups[0]["lr"] = learning_rate(config, step) / config.lr * tops[kind]
                optimizer.step()
            update_ema(ema, models, config.ema, step)

            done, last = step + 1, step + 1 == config.steps
            if done % config.log_every == 0 or last:
                row = {"step": done, "loss": float(total), **numbers, "grad_norm": float(norm)}
                table.append({**row, "lr": learning_rate(config, step)})
                bar.set_postfix(
                    {"loss": f"{row['loss']:.4f}", **{k: f"{v:.4g}" for k, v in metrics.items()}}, refresh=False
                )
            if done % config.validate_every == 0 or last:
                metrics = validate(ema) if team.first else {}
                table.append({"step": done, **metrics})
            if team.first and (done % config.save_every == 0 or last):
                _save(state_file, models, ema, optimizers, done, time.perf_counter() - clock, table, metrics, identity)
                write_table(table_file, table)
            bar.update(1)
    if table and team.first:
        from minicmdm.viz.plots import save_loss_curves

        write_table(table_file, table)
        with whole_file(folder / f"losses_{name}.png") as temporary:
            save_loss_curves(table_file, temporary)
    return LoopResult(ema, metrics, seconds if start >= config.steps else time.perf_counter() - clock)


def _drawn(key: int, draw: Draw) -> tuple[int, object, torch.Generator]:
    generator = torch.Generator().manual_seed(key)
    return key, draw(generator), generator


def _save(path, models, ema, optimizers, step, seconds, table, metrics, identity) -> None:
    """Everything the next life needs, in one file: tensors as tensors, the rest as JSON in the same file's header."""
    tensors = {f"model.{key}": value for key, value in models.state_dict().items()}
    tensors |= {f"ema.{key}": value for key, value in ema.state_dict().items()}
    for name, optimizer in optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}.{index}.{key}": value for key, value in moments.items()}
    note = {"step": step, "seconds": seconds, "table": table, "metrics": metrics, "identity": dict(identity)}
    save_tensors(path, tensors, note)


def _restore(path, models, ema, optimizers, identity) -> tuple[int, float, list[dict], dict]:
    tensors, note = load_tensors(path)
    theirs = note.get("identity", {}) if isinstance(note, dict) else {}
    if other := [key for key in identity if theirs.get(key) != identity[key]]:
        raise ValueError(f"{path} is the state of another run (its {', '.join(other)} differ): use another --out")
    groups: dict[str, dict] = {"model": {}, "ema": {}, **{name: {} for name in optimizers}}
    for key, value in tensors.items():
        group, _, rest = key.partition(".")
        groups[group][rest] = value
    models.load_state_dict(groups["model"])
    ema.load_state_dict(groups["ema"])
    for name, optimizer in optimizers.items():
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in groups[name].items():
            index, _, which = key.partition(".")
            moments.setdefault(int(index), {})[which] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})
    return note["step"], note["seconds"], note["table"], note["metrics"]


def write_table(path: Path, table: list[dict]) -> None:
    """Write the log as CSV: one row per logged or validated step, empty where a column was not measured."""
    columns = list(dict.fromkeys(column for row in table for column in row))
    with whole_file(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)
