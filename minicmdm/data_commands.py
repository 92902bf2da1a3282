"""What the commands about data sets and machines do: `data make`, `data info`, `import-bvh`, `doctor`. See cli.py."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from minicmdm.commands import say


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
    say(f"wrote {out}")


def data_info(arguments: argparse.Namespace) -> None:
    """`minicmdm data info`: a data set's card on stdout, and what is wrong with it, file by file, on stderr."""
    from minicmdm.data.inspection import inspect_folder

    card, wrong = inspect_folder(arguments.folder)
    if arguments.json:
        print(json.dumps({**card, "wrong": wrong}))
        return
    for name, value in card.items():
        print(f"{name:14s}{value}")
    for line in wrong:
        say(line)


def import_bvh(arguments: argparse.Namespace) -> None:
    """`minicmdm import-bvh`: a folder of BVH files as a data set that `train --data` reads."""
    if not arguments.out.strip():
        raise ValueError("--out must be a folder to make")
    from minicmdm.data.imports import import_bvh

    out = import_bvh(
        arguments.folder,
        arguments.out,
        joint_map=arguments.map,
        up=arguments.up,
        captions=arguments.captions,
        force=_ours(Path(arguments.out), arguments.force),
        say=say,
    )
    say(f"wrote {out}")


def _ours(out: Path, force: bool) -> bool:
    """Whether an --out that exists may be replaced: with --force, and only a data set in our layout or nothing."""
    if force and out.exists() and not (out.is_dir() and ((out / "train.txt").is_file() or not any(out.iterdir()))):
        raise FileExistsError(f"{out} holds something else than a data set and was left as it was")
    return force


def doctor(arguments: argparse.Namespace) -> None:
    """`minicmdm doctor`: this machine and installation, and what will not work."""
    from minicmdm.doctor import examine

    facts, wrong = examine()
    if arguments.json:
        print(json.dumps({**facts, "wrong": wrong}))
        return
    for name, value in facts.items():
        print(f"{name:18s}{value if value != [] else 'none'}")
    for line in wrong:
        print(f"! {line}")
