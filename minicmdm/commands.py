"""What each command of the command line does, once its arguments are read. See cli.py for the habits all share."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

MOST_CELLS = 1_000_000  # of a printed matrix


def say(line: str) -> None:
    """One line for people. Characters that their terminal has no letter for are escaped, never fatal."""
    encoding = getattr(sys.stderr, "encoding", None) or "ascii"
    print("minicmdm: " + line.encode(encoding, "backslashreplace").decode(encoding), file=sys.stderr, flush=True)


def _as_typed(argument: str) -> str:
    """A sentence as UTF-8, even where the locale (LC_ALL=C) knows ASCII only and handed us escaped bytes."""
    try:
        return os.fsencode(argument).decode("utf-8")
    except UnicodeError:
        return argument


def generate(arguments: argparse.Namespace) -> None:
    """`minicmdm generate`: everything that can be refused is refused before the first step of sampling."""
    from minicmdm.files import check_output
    from minicmdm.motion import ENDINGS

    prompt = _as_typed(arguments.prompt)
    if not prompt.strip():
        raise ValueError("the prompt is empty: say what to do, like 'a person walks, then waves'")
    out = check_output(arguments.out, ENDINGS, arguments.force)
    _one_thread()
    from minicmdm.data.features import retarget
    from minicmdm.pipeline import MotionPipeline

    pipe = MotionPipeline.from_pretrained(arguments.checkpoint)
    motion = pipe(
        prompt,
        num_frames=arguments.frames,
        schedule=arguments.schedule,
        num_steps=arguments.steps,
        uncertainty=arguments.uncertainty,
        guidance_scale=arguments.guidance,
        block_size=arguments.block,
        seed=arguments.seed,
    )
    if arguments.rigid:
        motion = replace(motion, joints=retarget(motion.joints, scale_path=False), features=None)
    motion.save(out, force=arguments.force)
    say(f"wrote {out} ({len(motion)} frames, {motion.seconds:.1f} s)")


def edit(arguments: argparse.Namespace) -> None:
    """`minicmdm edit`: a part of a motion stays, the rest is made anew."""
    from minicmdm.files import check_output
    from minicmdm.motion import ENDINGS, Motion, load_joints

    prompt = _as_typed(arguments.prompt)
    out = check_output(arguments.out, ENDINGS, arguments.force)
    joints = load_joints(arguments.file)
    _one_thread()
    from minicmdm.pipeline import MotionPipeline

    pipe = MotionPipeline.from_pretrained(arguments.checkpoint)
    if joints.shape[1] != (count := pipe.skeleton.num_joints):
        raise ValueError(f"{arguments.file} has {joints.shape[1]} joints, and {arguments.checkpoint} moves {count}")
    how = {"guidance_scale": arguments.guidance, "seed": arguments.seed}
    motion = pipe.edit(Motion(joints, fps=pipe.skeleton.fps), arguments.given, prompt, **how)
    motion.save(out, force=arguments.force)
    say(f"wrote {out} ({len(motion)} frames; given: {arguments.given.replace('_', ' ')})")


def stream(arguments: argparse.Namespace) -> None:
    """`minicmdm stream`: a timeline of prompts in, frames out as they come, until the timeline ends."""
    from minicmdm.files import check_output, whole_file

    out = None if arguments.out is None else check_output(arguments.out, (".jsonl", ".npy"), arguments.force)
    _one_thread()
    import numpy as np

    from minicmdm.data.features import retarget
    from minicmdm.live import follow, frame_line
    from minicmdm.pipeline import MotionPipeline

    pipe = MotionPipeline.from_pretrained(arguments.checkpoint)
    body = pipe.skeleton
    lines = _timeline(arguments.file, body.fps)
    first = next(lines, None)
    if first is None:
        raise ValueError("no prompt came: give lines of seconds, a tab and a prompt, like '4<TAB>a person walks'")
    flow = pipe.stream(
        first[1],
        lasts=first[0],
        schedule=arguments.schedule,
        num_steps=arguments.steps,
        uncertainty=arguments.uncertainty,
        guidance_scale=arguments.guidance,
        block_size=arguments.block,
        window=arguments.window,
        seed=arguments.seed,
    )

    frames = follow(flow, first, lines)
    if arguments.rigid:
        frames = ((prompt, retarget(joints[None], scale_path=False)[0]) for prompt, joints in frames)
    if out is None:
        for number, (prompt, joints) in enumerate(frames):
            print(frame_line(number, prompt, joints), flush=True)
        return
    count = 0
    with whole_file(out) as temporary, open(temporary, "wb") as file:

        def header() -> None:
            shape = {"descr": "<f4", "fortran_order": False, "shape": (count, body.num_joints, 3)}
            np.lib.format.write_array_header_1_0(file, shape)  # numpy leaves room for a count that grows

        if out.suffix.lower() == ".npy":
            header()
        for prompt, joints in frames:
            text = out.suffix.lower() == ".jsonl"
            file.write(frame_line(count, prompt, joints).encode() + b"\n" if text else joints.astype("<f4").tobytes())
            count += 1
        if out.suffix.lower() == ".npy":
            file.seek(0)
            header()
    say(f"wrote {out} ({count} frames, {count / body.fps:.1f} s)")


def _timeline(name: str, fps: float) -> Iterator[tuple[int, str]]:
    """The (frames, prompt) of each line of a file, or of "-", stdin, whose lines are read one by one as they come."""
    from minicmdm.live import timeline

    if name == "-":
        return timeline(getattr(sys.stdin, "buffer", sys.stdin), fps)
    if not Path(name).is_file():
        raise FileNotFoundError(f"no file {name}: lines of seconds, a tab and a prompt were expected there")
    with open(name, "rb") as file:
        return iter(list(timeline(file, fps)))  # a bad line is refused before any work


def demo(arguments: argparse.Namespace) -> None:
    """`minicmdm demo`: the shipped checkpoint acts out three sentences, and the oracle says what it sees."""
    from minicmdm.demo import outputs, perform

    files = outputs(Path(arguments.out), arguments.force)
    _one_thread()
    for prompt, seen, paths in perform(files, arguments.force):
        print(f'"{prompt}"\n  the oracle sees: ' + "; ".join(_in_words(segment.to_dict()) for segment in seen))
        print("  " + "\n  ".join(str(path.resolve()) for path in paths), flush=True)


def _one_thread() -> None:
    """The toy model is too small for two threads: on a busy machine they are ten times slower than one."""
    import torch

    torch.set_num_threads(1)


def _in_words(segment: dict) -> str:
    said = [str(segment[key]) for key in ("side", "direction", "speed", "overlay") if segment[key]]
    said += [f"{segment['count']} times"] * bool(segment["count"])
    return segment["action"] + (f" ({', '.join(said)})" if said else "")


def inspect(arguments: argparse.Namespace) -> None:
    """`minicmdm inspect`: segments in order, as the oracle reads them from the joints alone."""
    from minicmdm.motion import load_joints

    joints = load_joints(arguments.file)
    from minicmdm.data.oracle import read_motion

    segments = [segment.to_dict() for segment in read_motion(joints)]
    if arguments.json:
        print(json.dumps({"segments": segments}))
        return
    for segment in segments:
        print(f"frames {segment['start']:4d}-{segment['end']:<4d} {_in_words(segment)}")


def schedule(arguments: argparse.Namespace) -> None:
    """`minicmdm schedule`: the matrix, one row per moment, and what it costs."""
    from minicmdm.diffusion.schedules import cost, schedule_matrix

    stagger = {"full": 0, "autoregressive": arguments.steps}.get(arguments.kind, arguments.uncertainty)
    blocks = arguments.latents // max(arguments.block, 1)
    cells = arguments.latents * (arguments.steps + stagger * blocks + 1)
    if cells > MOST_CELLS:
        raise ValueError(f"a matrix of {cells} numbers is too much to print: take one of at most {MOST_CELLS}")
    matrix = schedule_matrix(arguments.latents, arguments.steps, arguments.uncertainty, arguments.block, arguments.kind)
    price = cost(matrix)
    if arguments.json:
        answer = {"matrix": matrix.tolist(), "calls": price.calls, "latents_in_flight": price.latents_in_flight}
        print(json.dumps(answer))
        return
    width = len(str(matrix.max()))
    label = len(str(len(matrix) - 1))
    for number, row in enumerate(matrix):
        print(f"row {number:{label}d} | " + " ".join(f"{level:{width}d}" for level in row))
    print(f"{price.calls} calls, at most {price.latents_in_flight} latents in flight")


def train(arguments: argparse.Namespace) -> None:
    """`minicmdm train`: all stages, or one of them."""
    if not 1 <= arguments.threads <= 1024:
        raise ValueError(f"--threads must be at least 1 and at most 1024, and {arguments.threads} came")
    if arguments.seed is not None and arguments.seed < 0:
        raise ValueError(f"--seed must not be negative, and {arguments.seed} came")
    if arguments.accumulate is not None and arguments.accumulate < 1:
        raise ValueError(f"--accumulate must be at least 1, and {arguments.accumulate} came")
    if not arguments.out.strip():
        raise ValueError("--out is empty: give a folder for the checkpoint")
    import torch

    from minicmdm.config import preset
    from minicmdm.training.stages import train as run

    torch.set_num_threads(arguments.threads)
    if arguments.dry_run:
        from minicmdm.models.text import with_encoder
        from minicmdm.training.estimate import estimate

        plan = preset(arguments.preset, arguments.system)
        if arguments.text is not None:
            plan = with_encoder(plan, arguments.text)
        for line in estimate(plan, arguments.accumulate or 1):
            say(str(line))
        return
    said = {key: value for key, value in vars(arguments).items() if key not in ("run", "command", "out", "dry_run")}
    flags = [
        f"--{key}" if value is True else f"--{key} {shlex.quote(str(value))}" for key, value in said.items() if value
    ]
    out = run(
        arguments.preset,
        arguments.out,
        arguments.stage,
        resume=arguments.resume,
        fast=arguments.fast,
        data=arguments.data,
        seed=arguments.seed,
        system=arguments.system,
        compile=arguments.compile,
        bf16=arguments.bf16,
        accumulate=arguments.accumulate,
        device=arguments.device,
        text=arguments.text,
        workers=arguments.workers,
        command=" ".join(["minicmdm train", *flags]),
        say=say,
    )
    say(f"wrote {out}")
