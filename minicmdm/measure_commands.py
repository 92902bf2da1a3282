"""What the commands that measure do: `evaluate` and `bench`. See cli.py."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from minicmdm.commands import _one_thread, say


def evaluate(arguments: argparse.Namespace) -> None:
    """`minicmdm evaluate`: the protocols as a table or JSON; with --quick, the flat numbers of a short one."""
    from minicmdm.files import check_output, write_text

    out = None if arguments.out is None else check_output(arguments.out, (".json", ".txt"), arguments.force)
    named = ("protocol", "evaluator", "repeats", "compositions", "prompts_each")
    asked = {key: value for key in named if (value := getattr(arguments, key)) is not None}
    sampling = {"schedule": arguments.schedule, "num_steps": arguments.steps}
    sampling |= {"uncertainty": arguments.uncertainty, "guidance_scale": arguments.guidance}
    sampling = {key: value for key, value in sampling.items() if value is not None}
    if arguments.quick and (asked or arguments.table or arguments.data):
        named = [f"--{key.replace('_', '-')}" for key in asked] + ["--table"] * arguments.table
        named += ["--data"] * bool(arguments.data)
        raise ValueError(f"--quick is a protocol of its own, with one flat list of numbers: leave out {named[0]}")
    if arguments.compare:
        more = [key for key in (*asked, *sampling) if key not in ("repeats", "limit")] + ["quick"] * arguments.quick
        if more:
            flag = {"num_steps": "steps", "guidance_scale": "guidance"}.get(more[0], more[0].replace("_", "-"))
            raise ValueError(f"--compare measures every system in its own way: leave out --{flag}")
    if arguments.limit is not None and arguments.limit < 1:
        raise ValueError(f"--limit must be at least 1, and {arguments.limit} came")
    _one_thread()
    from minicmdm.data.folders import load_dataset
    from minicmdm.evaluation import protocols
    from minicmdm.evaluation.evaluators import load_bench
    from minicmdm.evaluation.quick import evaluate_quick
    from minicmdm.pipeline import MotionPipeline

    if arguments.compare:
        from minicmdm.evaluation import compare

        result = compare.compare(**asked, limit=arguments.limit)
        text = compare.table(result)
    elif arguments.quick:
        pipe = MotionPipeline.from_pretrained(arguments.checkpoint)
        result = evaluate_quick(pipe, progress=True, limit=arguments.limit, **sampling)
        rows = [f"{k:36s} {v:.4g}" if isinstance(v, float) else f"{k:36s} {v}" for k, v in result.items()]
        text = "\n".join(rows)
    else:
        protocols.check(limit=arguments.limit, **asked)
        pipe = MotionPipeline.from_pretrained(arguments.checkpoint)
        asked |= {"checkpoint": arguments.checkpoint, "limit": arguments.limit}
        if arguments.data is not None:
            asked |= {"data": load_dataset(arguments.data, "test")}
            asked |= {"bench": load_bench(Path(arguments.checkpoint) / "evaluator")}
        result = protocols.evaluate(pipe, progress=True, **asked, **sampling)
        text = protocols.table(result)
    if out is not None:
        write_text(out, (json.dumps(result, indent=2) if out.suffix == ".json" else text) + "\n")
    encoding = getattr(sys.stdout, "encoding", None) or "ascii"  # a terminal without arrows gets question marks
    print(json.dumps(result) if arguments.json else text.encode(encoding, "replace").decode(encoding))
    if out is not None:
        say(f"wrote {out}")


def bench(arguments: argparse.Namespace) -> None:
    """`minicmdm bench`: what the stream saves, as one JSON object (a dot in a name is a level of it) or as a list."""
    from minicmdm.files import check_output, write_text

    out = None if arguments.out is None else check_output(arguments.out, (".json", ".txt"), arguments.force)
    _one_thread()
    from minicmdm.evaluation import bench as benchmark

    result = benchmark.bench(benchmark.QUICK if arguments.quick else benchmark.FULL, say)
    levels: dict = {}
    for name, value in result.items():
        group, _, leaf = name.rpartition(".")
        (levels.setdefault(group, {}) if group else levels)[leaf] = value
    short = json.loads(json.dumps(result), parse_float=lambda number: float(f"{float(number):.4g}"))
    text = "\n".join(f"{name:28s} {value}" for name, value in short.items())
    if out is not None:
        write_text(out, (json.dumps(levels, indent=2) if out.suffix == ".json" else text) + "\n")
    print(json.dumps(levels) if arguments.json else text)
    if out is not None:
        say(f"wrote {out}")
