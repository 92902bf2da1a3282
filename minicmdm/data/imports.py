"""A folder of BVH files becomes a data set."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from minicmdm.data.bvh import MAPS, Place, read_bvh, to_joints
from minicmdm.data.clips import Clip, MotionDataset, feature_statistics, fingerprint_of
from minicmdm.data.features import joints_to_features
from minicmdm.data.folders import SPLIT_NAMES, check_new_folder, write_folder
from minicmdm.data.programs import MIN_FRAMES
from minicmdm.data.skeleton import FPS

EVERY = 10  # one clip in ten goes to val and one to test; with fewer than ten clips all splits are the same


def import_bvh(
    folder: str | Path,
    out: str | Path,
    *,
    joint_map: str | Path | None = None,
    up: str = "y",
    captions: str | Path | None = None,
    force: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> Path:
    """Read every .bvh of a folder and write a data set in HumanML3D's layout, clips of every length.

    `joint_map` is one of `bvh.MAPS`, a JSON file of one's own (our 22 names -> theirs), or found by the joints' names.
    `captions` is a CSV of name,caption (several rows a name are several captions); without it the words of the file
    name are the caption. FileNotFoundError, FileExistsError, or ValueError with the file that cannot be read.
    """
    folder, out = Path(folder), check_new_folder(out, force)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}: a folder of .bvh files was expected")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".bvh")
    if not paths:
        raise FileNotFoundError(f"the folder {folder} holds no .bvh file")
    places = None if joint_map is None else load_map(joint_map)
    told = None if captions is None else read_csv(captions)
    if told is not None and (silent := [path.stem for path in paths if path.stem not in told]):
        raise ValueError(f"{captions} has no caption for {silent[0]} ({len(silent)} of {len(paths)} files)")
    clips = []
    for path in paths:
        try:
            joints = to_joints(read_bvh(path), places, up)
            features = joints_to_features(joints).astype(np.float32)  # (T,263)
        except ValueError as error:
            raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
        clips.append(Clip(path.stem, features, [words_of(path.stem)] if told is None else told[path.stem], []))
    mean, std = feature_statistics([clip.features for clip in clips])
    mark = fingerprint_of(clips)
    splits = split_clips(clips)
    short = sum(len(clip.features) < MIN_FRAMES for clip in clips)
    write_folder({name: MotionDataset(some, mean, std, mark) for name, some in splits.items()}, out, force)
    note = f", of which the loader leaves out {short} under {MIN_FRAMES} frames" if short else ""
    say(f"{len(clips)} clips, {sum(len(clip.features) for clip in clips) / FPS:.0f} s{note}")
    return out


def split_clips(clips: list[Clip]) -> dict[str, list[Clip]]:
    """Train, val and test: of every ten clips eight, one and one; all three the same where there are too few.

    A clip named "M" and another's name is its mirror image, as in HumanML3D, and goes where that one goes: a model that
    has been trained on one of them has seen the other.
    """
    names = {clip.name for clip in clips}
    first = {clip.name: clip.name.removeprefix("M") if clip.name[1:] in names else clip.name for clip in clips}
    order = {name: number for number, name in enumerate(dict.fromkeys(first.values()))}
    if len(order) < EVERY:
        return dict.fromkeys(SPLIT_NAMES, clips)
    kind = {name: {EVERY - 2: "val", EVERY - 1: "test"}.get(number % EVERY, "train") for name, number in order.items()}
    return {split: [clip for clip in clips if kind[first[clip.name]] == split] for split in SPLIT_NAMES}


def words_of(name: str) -> str:
    """A file's name as a caption: "dataset-2_wave-left-hand_normal_001" -> "a person: wave left hand normal"."""
    words = re.findall(r"[^\W\d_]+", re.sub(r"^dataset[-_ ]?\d+", "", name, flags=re.IGNORECASE))
    return f"a person: {' '.join(words).lower()}" if words else "a person moves"


def load_map(source: str | Path) -> dict[str, Place]:
    """A map by its name, or from a JSON file: our names -> a name, or [a, b, share]. FileNotFoundError, ValueError."""
    if str(source) in MAPS:
        return MAPS[str(source)]
    path = Path(source)
    if not path.is_file():
        raise FileNotFoundError(f"no joint map {source}: expected one of {', '.join(MAPS)}, or a JSON file")
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {
            name: where if isinstance(where, str) else (str(where[0]), str(where[1]), float(where[2]))
            for name, where in entries.items()
        }
    except (ValueError, AttributeError, TypeError, IndexError, KeyError, RecursionError) as error:
        raise ValueError(f"{path} is no joint map: expected our names -> a name or [a, b, share] ({error})") from error


def read_csv(path: str | Path) -> dict[str, list[str]]:
    """Captions by clip from a CSV with the columns name and caption. FileNotFoundError, ValueError."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: a CSV with the columns name and caption was expected")
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            if not {"name", "caption"} <= set(reader.fieldnames or ()):
                raise ValueError(f"{path} has the columns {reader.fieldnames}, and name and caption were expected")
            found: dict[str, list[str]] = {}
            for number, row in enumerate(reader, start=2):
                name, caption = (row[key] or "" for key in ("name", "caption"))
                if not name.strip() or not caption.strip():
                    raise ValueError(f"{path}, line {number}: a name and a caption were expected")
                found.setdefault(name.strip().removesuffix(".bvh"), []).append(caption.strip().replace("#", " "))
            return found
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8") from error
    except csv.Error as error:
        raise ValueError(f"{path} is no CSV ({error})") from error
