"""What the stream saves, measured: `minicmdm bench`, one thread, CPU time, ratios.

A speed-up says as much as what it is measured against. Here that is `as_released`, which does what CMDM's release does
in every call of the denoiser: all latents, waiting and finished ones too; the modulation of every latent anew; the keys
and values of the words anew. It has float32, fused attention and both branches of guidance in one batch, and our
layers, which are faster than the release's. `lean` does those last two things once and is the same otherwise. The
stream, besides, evaluates no latent that waits or is finished for good, and keeps its weights packed. All give the same
latents (`m.stream_error`). Then the checkpoint's stream against its 20 frames per second, and a stream that is ten
minutes old against a young one.
"""

from __future__ import annotations

import copy
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from minicmdm.config import PRESETS, DiTConfig
from minicmdm.diffusion.path import euler_step, level_to_time
from minicmdm.diffusion.schedules import closed_form_cost, schedule_matrix
from minicmdm.diffusion.streaming import LONGEST, LatentStream
from minicmdm.live import FPS
from minicmdm.models.dit import CausalDiT, self_attention_mask
from minicmdm.models.layers import sinusoid, turns
from minicmdm.models.packed import can_pack
from minicmdm.models.text import Words
from minicmdm.pipeline import MotionPipeline

WORDS, UNCERTAINTY, GUIDANCE = 20, 2, 3.0
PROMPT = "a person walks forward, then waves the left hand"
NOTE = "CPU time. Dense AR and full runs: the time of a dense FSS call, which is the same work, times their calls."
clock = time.perf_counter if os.name == "nt" else time.process_time  # Windows counts CPU time in ticks of 16 ms


@dataclass(frozen=True)
class Sizes:
    """What is measured; the defaults are the paper's M model and its released sampler."""

    dit: DiTConfig = replace(PRESETS["M"].dit, block_size=3)
    latents: int = 30
    num_steps: int = 50
    rounds: int = 3
    checkpoint: str = "toy"
    ages: tuple[int, ...] = (6, 60, 600)  # seconds of motion that a stream has behind it


FULL = Sizes()
QUICK = Sizes(num_steps=20, rounds=1, ages=(6, 12, 24))


def bench(sizes: Sizes = FULL, say: Callable[[str], None] = lambda line: None) -> dict[str, float | list | str]:
    """Everything in one run, as flat numbers with dotted names; `say` hears what is being measured."""
    pipe = MotionPipeline.from_pretrained(sizes.checkpoint)  # which may refuse, so it comes first
    say("(1/3) the M model: released, lean and streamed")
    result = model_numbers(sizes)
    say("(2/3) the checkpoint's stream")
    result |= toy_numbers(pipe, sizes.rounds)
    say(f"(3/3) streams of {', '.join(map(str, sizes.ages))} seconds")
    # A process of its own: in this one, the M model has already set the peak of memory.
    script = f"from minicmdm.evaluation.bench import grow; grow({sizes.checkpoint!r}, {sizes.ages})"
    done = subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.PIPE, text=True)
    return result | json.loads(done.stdout) | {"threads": torch.get_num_threads(), "note": NOTE}


# (a) The three samplers. Each yields, call by call, the latents which that call has finished, as `LatentStream.step`.
def dense(velocity: Callable, matrix: np.ndarray, z: Tensor, block_size: int) -> Iterator[Tensor]:
    """Guided Euler steps through a matrix (M,N) from noise z (1,N,C), with all latents in every call."""
    levels = torch.from_numpy(matrix)
    times = level_to_time(levels.to(z.dtype), int(matrix[0, 0])).unsqueeze(1)  # (M,1,N)
    hidden = ~self_attention_mask(z.shape[1], block_size, "causal")
    mask = torch.zeros_like(hidden, dtype=z.dtype).masked_fill(hidden, -torch.inf)  # in numbers, as the stream's
    for row in range(len(matrix) - 1):
        v_text, v_null = velocity(torch.cat([z, z]), levels[row].expand(2, -1), mask).chunk(2)
        z = euler_step(z, v_null + GUIDANCE * (v_text - v_null), times[row], times[row + 1])
        yield z[:, (levels[row] > 0) & (levels[row + 1] == 0)]


def as_released(dit: CausalDiT, words: Tensor, num_steps: int, z: Tensor, levels: Tensor, mask: Tensor) -> Tensor:
    """The denoiser as the release calls it, with words (2,S,E), a sentence and the null text, and z (2,N,C)."""
    t = level_to_time(levels.to(z.dtype), num_steps)
    noise = dit.embed_time(sinusoid(1000 * t, dit.cfg.time_dim))  # (2,N,dim): per latent, not per level
    where = turns(torch.arange(z.shape[1]), dit.cfg.dim // dit.cfg.heads, z.dtype)
    x, text = dit.embed_latent(z), dit.embed_words(words)
    for block in dit.blocks:
        x = block(x, block.modulation(noise), block.cross_attention.keys_values(text), None, mask, where)
    return dit.out(x)


def lean(dit: CausalDiT, words: Tensor, num_steps: int) -> Callable:
    """The same, but the modulation of the K+1 levels and the keys and values of the words are computed here, once."""
    tables = dit.modulations(level_to_time(torch.arange(num_steps + 1).to(words.dtype), num_steps))
    text = dit.keys_values(dit.embed_words(words))
    return lambda z, levels, mask: dit.evaluate(z, levels, tables, text, None, mask, torch.arange(z.shape[1]), None)


def samplers(dit: CausalDiT, sizes: Sizes) -> dict[str, Callable[[], Iterator[Tensor]]]:
    """What is timed, by name; what a run does once is done when it is called or makes its first step."""
    n, steps, block_size = sizes.latents, sizes.num_steps, dit.cfg.block_size
    seed = torch.Generator().manual_seed
    noise = torch.randn(LONGEST, dit.cfg.latent_dim, generator=seed(0))[None, :n]
    words = torch.randn(2, WORDS, dit.cfg.text_dim, generator=seed(1))
    words[1] = 0  # the release's null text
    known = torch.ones(1, WORDS, dtype=torch.bool)
    how = dict(num_steps=steps, uncertainty=UNCERTAINTY, block_size=block_size, guidance_scale=GUIDANCE, num_latents=n)
    half, matrix = copy.deepcopy(dit).to(torch.bfloat16), schedule_matrix(n, steps, UNCERTAINTY, block_size)

    def stream(model: CausalDiT, schedule: str) -> Iterator[Tensor]:
        text, null = (model.read(Words(one[None].to(model.out.weight), known)) for one in words)
        one = LatentStream(model, lambda _: text, null, ["a person"], [seed(0)], schedule=schedule, **how)
        while one.finished < n:
            yield one.step()

    return {
        "comparator": lambda: dense(partial(as_released, dit, words, steps), matrix, noise, block_size),
        "lean": lambda: dense(lean(dit, words, steps), matrix, noise, block_size),
        "fss": lambda: stream(dit, "fss"),
        "bf16": lambda: stream(half, "fss"),
        "ar": lambda: stream(dit, "autoregressive"),
        "full": lambda: stream(dit, "full"),
    }


@torch.no_grad()
def model_numbers(sizes: Sizes) -> dict[str, float]:
    """The ratios of (a), and the share (d) of the machine's matrix product in comparator and FSS stream."""
    dit = random_model(sizes.dit)
    runs = samplers(dit, sizes)
    count: list[int] = []  # latents times branches of each call, counted where every sampler comes by
    dit.out.register_forward_pre_hook(lambda _, x: count.append(x[0].shape[:2].numel()))
    calls, evaluations, latents = {}, {}, {}
    for _ in range(sizes.rounds):
        for name, run in runs.items():
            count.clear()
            marks, done = [clock()], []
            for z in run():
                marks.append(clock())
                done.append(z)
            # Whatever disturbs a machine only adds time: each call counts as in the round that disturbed it least.
            calls[name] = np.minimum(calls.get(name, np.inf), np.diff(marks))
            evaluations[name], latents[name] = sum(count), torch.cat(done, dim=1)

    result: dict[str, float] = {}
    for name, stagger in {"fss": UNCERTAINTY, "ar": sizes.num_steps, "full": 0}.items():
        number = closed_form_cost(sizes.latents, sizes.num_steps, stagger, sizes.dit.block_size).calls
        result[f"m.{name}_eval_ratio"] = number * 2 * sizes.latents / evaluations[name]
        for against, end in {"comparator": "", "lean": "_lean"}.items():
            first, others = calls[against][0], calls[against][1:].mean()  # the first also does what is done once
            result[f"m.{name}_time_ratio{end}"] = (first + others * (number - 1)) / calls[name].sum()
    result["m.bf16_time_ratio"] = calls["comparator"].sum() / calls["bf16"].sum()
    truth = latents["comparator"]
    error = {name: (latents[name] - truth).norm() / truth.norm() for name in ("lean", "fss", "bf16")}
    result |= {"m.bf16_error": error["bf16"], "m.stream_error": max(error["lean"], error["fss"])}
    result |= {f"m.{name}_call_ms": 1000 * times.mean() for name, times in calls.items()}

    result["matmul_gflops"] = peak = matmul_gflops()
    for name, end in {"comparator": "", "fss": "_stream"}.items():
        # Linear layers; attention's scores, 1 % more, it leaves out, and packed layers it would not know.
        with FlopCounterMode(display=False, custom_mapping=packed_flops()) as counter:
            list(runs[name]())
        result[f"matmul_share{end}"] = counter.get_total_flops() / 1e9 / calls[name].sum() / peak
    return {"m.num_steps": sizes.num_steps, **{name: float(number) for name, number in result.items()}}


def packed_flops() -> dict:
    """What a packed layer computes, for a counter that knows torch's own products only."""
    if not can_pack(torch.zeros(1)):
        return {}
    return {torch.ops.mkldnn._linear_pointwise: lambda x, *_, out_shape, **__: 2 * math.prod(x) * out_shape[-1]}


def random_model(cfg: DiTConfig) -> CausalDiT:
    """A model without training and without its zeros, which would hide what samplers do differently."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        dit = CausalDiT(cfg).eval()
        for layer in (dit.out, *(block.modulation for block in dit.blocks)):
            layer.reset_parameters()
    return dit


def matmul_gflops() -> float:
    """The best rate at which torch multiplies square float32 matrices here, in 1e9 operations a second."""
    best = 0.0
    for n in (256, 512, 1024, 2048) * 5:
        a, times = torch.rand(n, n), 1 + 10**9 // n**3
        best = max(best, 2e-6 * n**3 * times / spent(partial(torch.mm, a, a), times))
    return best


def spent(work: Callable, times: int) -> float:
    """The CPU milliseconds that it takes to do something so often."""
    start = clock()
    for _ in range(times):
        work()
    return 1000 * (clock() - start)


# (b), (c) The checkpoint's stream, from the sentence to the frames.
def toy_numbers(pipe: MotionPipeline, rounds: int) -> dict[str, float]:
    """The first frame, counted from the sentence on, and the price of latents once the window is full."""
    result: dict[str, float] = {}
    for steps, end in {20: "", 10: "_k10", 50: "_k50"}.items():
        begin = partial(pipe.stream, PROMPT, num_steps=steps)
        result[f"toy.first_frame_ms{end}"] = min(spent(lambda: next(begin()), 1) for _ in range(rounds + 2))  # noqa: B023
        frame, window = partial(next, begin()), 4 * LONGEST  # frames a window long, in which the cache slides once
        spent(frame, window)
        best = min(spent(frame, window) for _ in range(rounds))
        result |= {f"toy.ms_per_latent{end}": best / LONGEST, f"toy.realtime_factor{end}": window / FPS * 1000 / best}
    return result


def grow(checkpoint: str, ages: tuple[int, ...]) -> None:
    """Print, as JSON, the peak memory of a stream as it grows old, and what latents cost streams of all ages then.

    They make their next six seconds in turns, so that whatever else this machine does hits all of them alike.
    """
    torch.set_num_threads(1)
    pipe = MotionPipeline.from_pretrained(checkpoint)
    streams, status, peaks = [partial(next, pipe.stream(PROMPT)) for _ in ages], Path("/proc/self/status"), []
    for before, age in zip((0, *ages), ages):
        spent(streams[-1], FPS * (age - before))
        most = re.search(r"VmHWM:\s*(\d+)", status.read_text()) if status.is_file() else None
        peaks.append(int(most[1]) / 1024 if most else None)  # MB; only Linux says so
    for stream, age in zip(streams, ages[:-1]):
        spent(stream, FPS * age)
    times = np.median([[spent(stream, 4) for stream in streams] for _ in range(30)], axis=0).tolist()
    print(json.dumps({"growth.seconds": ages, "growth.ms_per_latent": times, "growth.peak_mb": peaks}))
