"""The command line: `minicmdm demo | generate | inspect | schedule | data | train | evaluate`.

Three habits hold for every command. What others parse (JSON, a matrix) goes to stdout; what people read while they wait
goes to stderr. Whatever is wrong with a request is said in one line that begins "minicmdm: ", the exit code is 2, and
nothing on the disk has changed. And `--help` is instant: each command imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

WRONG, INTERRUPTED, READER_GONE = 2, 130, 141  # exit codes; the last two are what a shell reports for the signals
MOST_CELLS = 1_000_000  # of a printed matrix


class Parser(argparse.ArgumentParser):
    """argparse, but a mistake is a ValueError like any other, so that it ends in the same one line."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (`{self.prog} --help` shows what it takes)")


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 for a request that cannot be met."""
    try:
        arguments = _parser().parse_args(argv)
        arguments.run(arguments)
        sys.stdout.flush()
        return 0
    except SystemExit as stop:  # --help and --version
        return int(stop.code or 0)
    except KeyboardInterrupt:
        _say("interrupted")
        return INTERRUPTED
    except BrokenPipeError:  # `minicmdm schedule ... | head -1`: whoever read us has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_GONE
    except (ValueError, OSError, MemoryError) as error:
        _say(_one_line(error))
        return WRONG


def _say(line: str) -> None:
    """One line for people. Characters that their terminal has no letter for are escaped, never fatal."""
    encoding = getattr(sys.stderr, "encoding", None) or "ascii"
    print("minicmdm: " + line.encode(encoding, "backslashreplace").decode(encoding), file=sys.stderr, flush=True)


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:  # "No space left on device: walk.html"
        text = error.strerror + (f": {error.filename}" if error.filename else "")
    else:
        text = str(error) or type(error).__name__
    return " ".join(text.split())


def _as_typed(argument: str) -> str:
    """A sentence as UTF-8, even where the locale (LC_ALL=C) knows ASCII only and handed us escaped bytes."""
    try:
        return os.fsencode(argument).decode("utf-8")
    except UnicodeError:
        return argument


def _parser() -> Parser:
    import minicmdm

    parser = Parser(prog="minicmdm", description="A sentence in, a moving skeleton out.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"minicmdm {minicmdm.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, dest="command")

    def command(name: str, run: Callable, help: str, under=commands) -> Parser:
        sub = under.add_parser(name, help=help, description=help, allow_abbrev=False)
        sub.set_defaults(run=run)
        return sub

    sub = command("demo", demo, "Three sentences become three motions: an HTML player and a GIF of each.")
    sub.add_argument("--out", default="demo", help="folder for the files, made if missing (default demo)")
    sub.add_argument("--force", action="store_true", help="replace files that exist")

    sub = command("generate", generate, "Turn a sentence into a motion: an .html player, a .gif, or an .npy of joints.")
    sub.add_argument("prompt", metavar="PROMPT", help='what to do, for example "a person walks, then waves"')
    sub.add_argument("--out", default="motion.html", help="file to write: .html, .gif or .npy (default motion.html)")
    sub.add_argument("--frames", type=int, default=120, help="length at 20 frames per second, 4 to 196 (default 120)")
    sub.add_argument("--seed", type=int, default=0, help="another seed, another motion (default 0)")
    sub.add_argument("--steps", type=int, default=20, help="K, denoising steps of each latent (default 20)")
    sub.add_argument(
        "--uncertainty", type=int, default=2, help="L, how many steps later the next latent starts (default 2)"
    )
    sub.add_argument("--guidance", type=float, default=3.0, help="guidance scale; 1 turns guidance off (default 3)")
    sub.add_argument("--schedule", default="fss", help="fss, full or autoregressive (default fss)")
    sub.add_argument("--block", type=int, help="latents that are denoised together (default: the model's own)")
    sub.add_argument("--checkpoint", default="toy", help="toy, or a folder made by `minicmdm train` (default toy)")
    sub.add_argument("--force", action="store_true", help="replace an output that exists")

    sub = command("inspect", inspect, "Read a motion back: what does the oracle see in an .npy of joints (T,22,3)?")
    sub.add_argument("file", metavar="FILE", help="an .npy of joints in metres")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("schedule", schedule, "Print a scheduling matrix: which latent is how noisy, call by call.")
    sub.add_argument("--latents", type=int, default=8, help="N (default 8)")
    sub.add_argument("--steps", type=int, default=6, help="K (default 6)")
    sub.add_argument("--uncertainty", type=int, default=2, help="L (default 2)")
    sub.add_argument("--block", type=int, default=1, help="latents per block (default 1)")
    sub.add_argument("--kind", default="fss", help="fss, full or autoregressive (default fss)")
    sub.add_argument("--json", action="store_true", help="print JSON")

    data = commands.add_parser("data", help="Make data sets.", description="Make data sets.", allow_abbrev=False)
    actions = data.add_subparsers(metavar="ACTION", required=True, dest="action")
    sub = command("make", data_make, "Write the synthesised toy world as a folder in HumanML3D's layout.", actions)
    sub.add_argument("--out", required=True, help="folder to make")
    sub.add_argument("--force", action="store_true", help="replace a data set that is there already")

    sub = command("train", train, "Train a preset from nothing: the VAE, then the denoiser.")
    sub.add_argument("--preset", default="toy", help="toy, S, M, L or XL (default toy)")
    sub.add_argument("--out", required=True, help="checkpoint folder to make")
    sub.add_argument("--stage", default="all", help="vae, dit or all (default all)")
    sub.add_argument("--resume", action="store_true", help="go on with the run in --out")
    sub.add_argument(
        "--fast", action="store_true", help="a smoke run of seconds: everything happens, nothing is learnt"
    )
    sub.add_argument("--data", help="a folder in HumanML3D's layout (default: the toy world)")
    sub.add_argument("--seed", type=int, help="seed of weights and batches (default: the preset's)")
    sub.add_argument(
        "--threads", type=int, default=1, help="CPU threads; on one, a run repeats bit for bit (default 1)"
    )

    sub = command("evaluate", evaluate, "Measure a checkpoint: does the motion do what its sentence asked?")
    sub.add_argument("--quick", action="store_true", help="the quick protocol (the only one so far)")
    sub.add_argument("--json", action="store_true", help="print one flat JSON object")
    sub.add_argument("--checkpoint", default="toy", help="toy, or a folder made by `minicmdm train` (default toy)")
    sub.add_argument("--limit", type=int, help="use only the first so many clips of each split")
    return parser


def generate(arguments: argparse.Namespace) -> None:
    """`minicmdm generate`: everything that can be refused is refused before the first step of sampling."""
    from minicmdm.files import check_output
    from minicmdm.motion import ENDINGS

    prompt = _as_typed(arguments.prompt)
    if not prompt.strip():
        raise ValueError("the prompt is empty: say what to do, like 'a person walks, then waves'")
    out = check_output(arguments.out, ENDINGS, arguments.force)
    _one_thread()
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
    motion.save(out, force=arguments.force)
    _say(f"wrote {out} ({len(motion)} frames, {motion.seconds:.1f} s)")


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


def data_make(arguments: argparse.Namespace) -> None:
    """`minicmdm data make`: the toy world in HumanML3D's folder layout."""
    out = Path(arguments.out)
    if not arguments.out.strip() or (out.exists() and not out.is_dir()):
        raise FileExistsError(f"--out must be a folder to make, and {arguments.out or 'nothing'} is a file or empty")
    if not out.absolute().parent.is_dir():
        raise FileNotFoundError(f"the folder {out.absolute().parent} for {out.name} does not exist: make it first")
    filled = out.is_dir() and any(out.iterdir())
    if filled and not arguments.force:
        raise FileExistsError(f"the folder {out} is not empty and was left as it is: --force replaces a data set")
    if filled and not (out / "programs.jsonl").is_file():  # --force deletes: only ever a data set of ours
        raise FileExistsError(f"the folder {out} holds something else than toy data and was left as it is")
    from minicmdm.data.dataset import make_folder

    make_folder(out, force=out.is_dir())
    _say(f"wrote {out}")


def train(arguments: argparse.Namespace) -> None:
    """`minicmdm train`: both stages, or one of them."""
    if arguments.threads < 1:
        raise ValueError(f"--threads must be at least 1, and {arguments.threads} came")
    if arguments.seed is not None and arguments.seed < 0:
        raise ValueError(f"--seed must not be negative, and {arguments.seed} came")
    if not arguments.out.strip():
        raise ValueError("--out is empty: give a folder for the checkpoint")
    import torch

    from minicmdm.training.stages import train as run

    torch.set_num_threads(arguments.threads)
    said = {key: value for key, value in vars(arguments).items() if key not in ("run", "command", "out")}
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
        command=" ".join(["minicmdm train", *flags]),
        say=_say,
    )
    _say(f"wrote {out}")


def evaluate(arguments: argparse.Namespace) -> None:
    """`minicmdm evaluate --quick`: the numbers by which a checkpoint is judged."""
    if not arguments.quick:
        raise ValueError("evaluate knows one protocol so far: add --quick")
    if arguments.limit is not None and arguments.limit < 1:
        raise ValueError(f"--limit must be at least 1, and {arguments.limit} came")
    _one_thread()
    from minicmdm.evaluation.quick import evaluate_quick
    from minicmdm.pipeline import MotionPipeline

    numbers = evaluate_quick(MotionPipeline.from_pretrained(arguments.checkpoint), progress=True, limit=arguments.limit)
    if arguments.json:
        print(json.dumps(numbers))
        return
    for name, value in numbers.items():
        print(f"{name:36s} {value:.4g}" if isinstance(value, float) else f"{name:36s} {value}")


if __name__ == "__main__":
    sys.exit(main())
