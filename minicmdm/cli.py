"""The command line: `minicmdm demo | generate | stream | edit | inspect | schedule | data | import-bvh | train | ...`.

Three habits hold for every command. What others parse (JSON, a matrix) goes to stdout; what people read while they wait
goes to stderr. Whatever is wrong with a request is said in one line that begins "minicmdm: ", the exit code is 2, and
nothing on the disk has changed. And `--help` is instant: each command imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from minicmdm.commands import demo, edit, generate, inspect, say, schedule, stream, train
from minicmdm.data_commands import data_info, data_make, doctor, import_bvh
from minicmdm.measure_commands import bench, evaluate

CHECKPOINT = "toy, flood, mardm, cdamd, or a folder made by `minicmdm train` (default toy)"
RIGID = "give every bone its length again, which a generated one keeps to about a centimetre"
WRONG, INTERRUPTED, READER_GONE = 2, 130, 141  # exit codes; the last two are what a shell reports for the signals


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
        say("interrupted")
        return INTERRUPTED
    except BrokenPipeError:  # `minicmdm schedule ... | head -1`: whoever read us has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_GONE
    except (ValueError, OSError, MemoryError) as error:
        say(_one_line(error))
        return WRONG


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:  # "No space left on device: walk.html"
        text = error.strerror + (f": {error.filename}" if error.filename else "")
    else:
        text = str(error) or type(error).__name__
    return " ".join(text.split())


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

    def sampling(sub: Parser, schedules: str) -> None:
        sub.add_argument("--seed", type=int, default=0, help="another seed, another motion (default 0)")
        sub.add_argument("--steps", type=int, help="K, denoising steps a latent (default: the system's, of cmdm 20)")
        sub.add_argument("--uncertainty", type=int, help="L, steps before the next latent starts (default: of cmdm 2)")
        sub.add_argument("--guidance", type=float, default=3.0, help="guidance scale; 1 turns guidance off (default 3)")
        sub.add_argument("--schedule", help=f"{schedules} (default: the system's, of cmdm fss)")
        sub.add_argument("--block", type=int, help="latents that are denoised together (default: the model's own)")
        sub.add_argument("--checkpoint", default="toy", help=CHECKPOINT)
        sub.add_argument("--force", action="store_true", help="replace an output that exists")

    sub = command("generate", generate, "Turn a sentence into a motion: an .html player, .gif, .bvh or .npy of joints.")
    sub.add_argument("prompt", metavar="PROMPT", help='what to do, for example "a person walks, then waves"')
    sub.add_argument("--out", default="motion.html", help=".html, .gif, .bvh or .npy (default motion.html)")
    sub.add_argument("--frames", type=int, default=120, help="length at 20 frames per second, 4 to 196 (default 120)")
    sub.add_argument("--rigid", action="store_true", help=RIGID)
    sampling(sub, "fss, full or autoregressive")

    sub = command("stream", stream, "Turn lines of SECONDS<TAB>PROMPT into frames as they come: one JSON line each.")
    sub.add_argument(
        "file", metavar="FILE", nargs="?", default="-", help="the timeline (default -: stdin, line by line)"
    )
    sub.add_argument("--out", help="write a .jsonl or .npy file rather than to stdout")
    sub.add_argument("--rigid", action="store_true", help=RIGID)
    sub.add_argument("--window", type=int, help="the most latents that one call sees (default 49, or those in flight)")
    sampling(sub, "fss, autoregressive or triangular")

    sub = command("edit", edit, "Keep a part of a motion and make the rest of it anew, for a sentence.")
    sub.add_argument("file", metavar="FILE", help="an .npy of joints in metres, 16 to 196 frames")
    sub.add_argument("prompt", metavar="PROMPT", help="what all of the motion is to be")
    sub.add_argument("--given", default="first_half", help="first_half, second_half, ends or middle is kept")
    sub.add_argument("--out", default="edited.html", help=".html, .gif, .bvh or .npy (default edited.html)")
    sub.add_argument("--guidance", type=float, default=3.0, help="guidance scale; 1 turns guidance off (default 3)")
    sub.add_argument("--seed", type=int, default=0, help="another seed, another motion (default 0)")
    sub.add_argument("--checkpoint", default="mardm", help="mardm, cdamd, toy, flood or a folder (default mardm)")
    sub.add_argument("--force", action="store_true", help="replace an output that exists")

    sub = command("inspect", inspect, "Read a motion back: what does the oracle see in an .npy of joints (T,22,3)?")
    sub.add_argument("file", metavar="FILE", help="an .npy of joints in metres")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("schedule", schedule, "Print a scheduling matrix: which latent is how noisy, call by call.")
    sub.add_argument("--latents", type=int, default=8, help="N (default 8)")
    sub.add_argument("--steps", type=int, default=6, help="K (default 6)")
    sub.add_argument("--uncertainty", type=int, default=2, help="L (default 2)")
    sub.add_argument("--block", type=int, default=1, help="latents per block (default 1)")
    sub.add_argument("--kind", default="fss", help="fss, full, autoregressive, triangular or trapezoid (default fss)")
    sub.add_argument("--json", action="store_true", help="print JSON")

    about = "Make data sets, and look at them."
    data = commands.add_parser("data", help=about, description=about, allow_abbrev=False)
    actions = data.add_subparsers(metavar="ACTION", required=True, dest="action")
    sub = command("make", data_make, "Write the synthesised toy world as a folder in HumanML3D's layout.", actions)
    sub.add_argument("--out", required=True, help="folder to make")
    sub.add_argument("--force", action="store_true", help="replace a data set that is there already")

    sub = command("info", data_info, "A data set's card, and what is wrong with its folder, file by file.", actions)
    sub.add_argument("folder", metavar="DIR", help="a folder in HumanML3D's layout")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("import-bvh", import_bvh, "Make a data set of a folder of BVH files: 22 joints, 20 fps, captions.")
    sub.add_argument("folder", metavar="DIR", help="a folder of .bvh files")
    sub.add_argument("--out", required=True, help="folder to make, in HumanML3D's layout")
    sub.add_argument("--map", help="smpl, bandai-namco, mixamo, or a JSON file (default: found by the joints' names)")
    sub.add_argument("--up", default="y", help="the axis that points up in the files, y or z (default y)")
    sub.add_argument("--captions", help="a CSV of name,caption (default: the words of each file's name)")
    sub.add_argument("--force", action="store_true", help="replace a data set that is there already")

    sub = command("doctor", doctor, "What is installed, how fast this machine is, and what will not work.")
    sub.add_argument("--json", action="store_true", help="print JSON")

    sub = command("train", train, "Train a preset from nothing: judges, teacher, VAE, denoiser.")
    sub.add_argument("--preset", default="toy", help="toy, micro, S, M, L or XL (default toy)")
    sub.add_argument("--system", default="cmdm", help="cmdm, flood, mardm, cdamd or window (default cmdm)")
    sub.add_argument("--out", required=True, help="checkpoint folder to make")
    sub.add_argument("--stage", default="all", help="evaluator, tmr, vae, dit or all (default all)")
    sub.add_argument("--resume", action="store_true", help="go on with the run in --out")
    sub.add_argument(
        "--fast", action="store_true", help="a smoke run of seconds: everything happens, nothing is learnt"
    )
    sub.add_argument("--data", help="a folder in HumanML3D's layout (default: the toy world)")
    sub.add_argument("--text", help="a pretrained text encoder, kept as it is: minilm, a folder, or a hub name")
    sub.add_argument("--seed", type=int, help="seed of weights and batches (default: the preset's)")
    sub.add_argument(
        "--bf16", action="store_true", help="compute in bfloat16; weights stay float32 (toy and micro always)"
    )
    sub.add_argument("--compile", action="store_true", help="train faster; needs a C++ compiler on this machine")
    sub.add_argument(
        "--threads", type=int, default=1, help="CPU threads; on one, a run repeats bit for bit (default 1)"
    )
    sub.add_argument("--dry-run", action="store_true", help="say what it will need, and stop")
    sub.add_argument("--device", default="cpu", help="cpu, cuda, mps ... (default cpu)")
    sub.add_argument("--workers", type=int, default=0, help="threads that draw batches ahead (default 0)")
    sub.add_argument("--accumulate", type=int, help="batches whose gradients make one step; processes share them")

    sub = command("evaluate", evaluate, "Measure a checkpoint: does the motion do what its sentence asked?")
    sub.add_argument("--checkpoint", default="toy", help=CHECKPOINT)
    sub.add_argument("--compare", action="store_true", help="the four shipped systems, side by side")
    sub.add_argument(
        "--data", help="a folder whose test.txt to answer; judges: `train --stage evaluator` (default: the toy world)"
    )
    sub.add_argument(
        "--protocol",
        help="t2m (text to motion), recon (the VAE and back), long (many prompts in a row) or mtt (timelines of "
        "three); the first two if not given",
    )
    sub.add_argument("--compositions", type=int, help="long or mtt: how many (default 16 or 64; the papers' 64 or 500)")
    sub.add_argument(
        "--prompts-each", type=int, help="long or mtt: prompts in each (default 8 or 3; the papers' 32, 3)"
    )
    sub.add_argument("--schedule", help="fss, full, autoregressive, triangular or trapezoid (default: of cmdm fss)")
    sub.add_argument("--steps", type=int, help="K (default: the system's, of cmdm 20)")
    sub.add_argument("--uncertainty", type=int, help="L (default: the system's, of cmdm 2)")
    sub.add_argument("--guidance", type=float, help="guidance scale (default 3)")
    sub.add_argument("--repeats", type=int, help="how often all prompts are answered, or others drawn (default 5)")
    sub.add_argument("--limit", type=int, help="only the first so many test clips, at least 32 unless --quick")
    sub.add_argument(
        "--evaluator", help="t2m or t2m_essential, the judge of 263 or 67 features (default t2m_essential)"
    )
    sub.add_argument("--quick", action="store_true", help="one answer a prompt, the oracle alone, flat numbers")
    form = sub.add_mutually_exclusive_group()
    form.add_argument("--table", action="store_true", help="print a table (this is the default)")
    form.add_argument("--json", action="store_true", help="print one JSON object")
    sub.add_argument("--out", help="write it too: .json, or .txt for the table")
    sub.add_argument("--force", action="store_true", help="replace an output that exists")

    sub = command("bench", bench, "Time the stream against the released sampler, the clock and itself (four minutes).")
    sub.add_argument("--quick", action="store_true", help="fewer steps, one round, young streams: half a minute")
    sub.add_argument("--json", action="store_true", help="print one JSON object")
    sub.add_argument("--out", help="write it too: .json, or .txt for the list")
    sub.add_argument("--force", action="store_true", help="replace an output that exists")
    return parser


if __name__ == "__main__":
    sys.exit(main())
