"""Data sets on disk, in HumanML3D's layout: read, checked file by file, and written.

    folder/new_joint_vecs/NAME.npy     (T, 263) features; KIT-ML's are (T, 251)
    folder/texts/NAME.txt              one "caption#tokens#start#end" a line, in seconds; 0 and 0 mean the whole clip
    folder/train.txt val.txt test.txt  names of each split
    folder/Mean.npy Std.npy            (263,) or (251,)
    folder/programs.jsonl              toy data only: the program behind each clip and a sentence for each segment
    folder/train.json val.json ...     BABEL only: labels of stretches of each clip, several sentences a motion

The same reader loads the sample in data_toy/, a generated set, imported BVH files, and a real HumanML3D or KIT-ML
folder: the width of its features says which, and so at how many frames a second its captions count.
A caption with a start and an end belongs to that stretch alone, so it becomes a clip of its own, as in HumanML3D's own
loader. Nothing is ever unpickled, and no name leads out of the folder.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path, PurePosixPath

import numpy as np

from minicmdm.data.clips import Clip, MotionDataset, feature_statistics, fingerprint_of
from minicmdm.data.programs import MAX_FRAMES, MIN_FRAMES, Program, Segment
from minicmdm.data.skeleton import FPS, KIT21, SKELETONS, skeleton_of
from minicmdm.files import NO_NPY

WIDTHS = tuple(body.num_features for body in SKELETONS)  # 263, 251
SPLIT_NAMES = ("train", "val", "test")
ADVICE = "`minicmdm data info` lists all that is wrong with a folder"


def load_dataset(folder: str | Path, split: str = "train") -> MotionDataset:
    """Read one split of a folder in HumanML3D's layout.

    Clips under 40 frames are left out (in KIT-ML under 24: their own rules) and those over 196 are cut.
    FileNotFoundError for a missing folder, split or file and ValueError for anything that cannot be read as it should,
    or is of another width than the rest, with the file's name.
    """
    folder = Path(folder)
    records = clip_records(folder, split)
    clips: list[Clip] = []
    for name in split_names(folder, split):
        clips += read_clips(folder, name, records.get(name, {}))
        if clips and (strange := other_width(clips[0].features, clips[-1].features)):
            raise ValueError(f"{folder / 'new_joint_vecs' / name}.npy {strange}")
    if not clips:
        least = f"{MIN_FRAMES} frames (of KIT-ML {KIT21.min_frames})"
        raise ValueError(f"{folder / split}.txt leaves no clip of at least {least}; {ADVICE}")
    width = clips[0].features.shape[1]
    mean, std = read_statistics(folder, width) or feature_statistics([clip.features for clip in clips])
    note = folder / "fingerprint.txt"
    fingerprint = _text(note).strip() if note.is_file() else fingerprint_of(clips)
    return MotionDataset(clips, mean, std, fingerprint)


def split_names(folder: Path, split: str) -> list[str]:
    """The names in a split's file, each a plain one. ValueError: one that leads elsewhere, or no name at all."""
    listing = folder / f"{split}.txt"
    if not listing.is_file():
        raise FileNotFoundError(f"no {split}.txt in {folder}: expected a folder in HumanML3D's layout")
    names = [line.strip() for line in _text(listing).splitlines() if line.strip()]
    for name in names:
        if PurePosixPath(name).name != name or "\\" in name or ":" in name or name in (".", ".."):
            raise ValueError(f"{listing} names {name!r}: a clip's name leads to no other folder")
    if not names:
        raise ValueError(f"{listing} names no clip")
    return names


def read_clips(folder: Path, name: str, record: dict) -> list[Clip]:
    """A motion as `cut_clips` makes clips of it. FileNotFoundError and ValueError as `load_dataset`."""
    features = read_features(folder / "new_joint_vecs" / f"{name}.npy", f"{name} is in a split, but its file")
    fps = skeleton_of(features.shape[1]).fps
    captions = read_captions(folder / "texts" / f"{name}.txt", len(features), fps)
    return cut_clips(folder, name, features, captions, record)


Captions = tuple[list[str], dict[tuple[int, int], list[str]]]  # of the whole clip, and of stretches of it


def cut_clips(folder: Path, name: str, features: np.ndarray, captions: Captions, record: dict) -> list[Clip]:
    """One clip for what is said of the whole motion, and one for each stretch that has captions of its own.

    Those too short for their data set are left out. ValueError: labels that are no stretches of the motion.
    """
    whole, stretches = captions
    labels = [tuple(label) for label in record.get("labels", [])]
    for start, end, text in labels:
        if not 0 <= start < end <= len(features) or not text.strip():
            raise ValueError(f"{folder}: a label of {name} is no stretch of its {len(features)} frames with words")
    clips = []
    if whole or labels:
        said = whole or [", then ".join(text for _, _, text in labels)]
        labels = [(start, min(end, MAX_FRAMES), text) for start, end, text in labels if start < MAX_FRAMES]
        asked, realised = _program(record.get("asked")), _program(record.get("realised"))
        kind = record.get("kind", "ordinary")
        clips.append(Clip(name, features[:MAX_FRAMES], said, labels, asked, realised, kind))
    for number, ((start, end), captions) in enumerate(stretches.items()):
        clips.append(Clip(f"{name}@{number}", features[start:end][:MAX_FRAMES], captions, []))
    return [clip for clip in clips if len(clip.features) >= skeleton_of(features.shape[1]).min_frames]


def other_width(first: np.ndarray, features: np.ndarray) -> str:
    """What is wrong with features (T,D) that are not as wide as the first ones of their folder; "" if they are."""
    if first.shape[1] == features.shape[1]:
        return ""
    return (
        f"holds {features.shape[1]} features a frame, and what was read before it {first.shape[1]}: one body a folder"
    )


def read_features(path: Path, what: str = "the file") -> np.ndarray:
    """Features (T, 263 or 251) as float32. FileNotFoundError; ValueError: pickled, cut, another width, not finite."""
    if not path.is_file():
        raise FileNotFoundError(f"{what} {path} is not there")
    features = _array(path)
    if features.ndim != 2 or features.shape[1] not in WIDTHS or not len(features):
        told = " or ".join(f"(T, {width})" for width in WIDTHS)
        raise ValueError(f"{path}: expected finite features of shape {told}, got shape {features.shape}")
    if features.dtype.kind in "fiu":
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused
            features = features.astype(np.float32)
    if features.dtype.kind not in "fiu" or not np.isfinite(features).all():
        bad = np.argwhere(~np.isfinite(features))[0, 0] if features.dtype.kind == "f" else "0"
        raise ValueError(f"{path}: expected finite features, but frame {bad} is not, or it holds {features.dtype}")
    return features


def read_captions(path: Path, frames: int, fps: float = FPS) -> Captions:
    """What is said of the whole clip, and of stretches of it: (start, end) in frames -> captions.

    FileNotFoundError; ValueError: no UTF-8, no caption at all, or a stretch that is none.
    """
    if not path.is_file():
        raise FileNotFoundError(f"the captions {path} are not there")
    whole, stretches, late = [], {}, 0
    for number, row in enumerate(_text(path).splitlines(), start=1):
        caption, _, rest = row.partition("#")
        if not caption.strip():
            continue
        marks = rest.rsplit("#", 2)[-2:] if rest.count("#") >= 2 else ["0.0", "0.0"]
        try:
            start, end = (0.0 if math.isnan(float(mark)) else float(mark) for mark in marks)
        except ValueError:
            raise ValueError(f"{path}, line {number}: start and end are seconds, got {'#'.join(marks)}") from None
        if start == end == 0:
            whole.append(caption.strip())
        elif 0 <= start < end < math.inf:
            stretch = int(fps * start), min(int(fps * end), frames)
            if stretch[0] < stretch[1]:
                stretches.setdefault(stretch, []).append(caption.strip())
            late += stretch[0] >= stretch[1]
        else:
            raise ValueError(f"{path}, line {number}: from {start} to {end} seconds is no stretch of a motion")
    if late and not whole and not stretches:
        raise ValueError(f"{path}: what it tells of begins after the clip's end, at {frames / fps:.2f} seconds")
    if not whole and not stretches:
        raise ValueError(f"{path} holds no caption: lines like 'a person walks.#a/DET person/NOUN#0.0#0.0' go there")
    return whole, stretches


def babel_labels(path: Path) -> dict[str, list[tuple[int, int, str]]]:
    """BABEL's labels of stretches: for each clip (start, end, sentence) in frames, in their order.

    Reads `frame_ann.labels` with `start_t`, `end_t` in seconds and `raw_label` or `proc_label`, the layout of the
    published train.json and val.json; where stretches overlap, the later one begins where it says. ValueError: no JSON.
    """
    try:
        entries = json.loads(_text(path))
        found = {}
        for name, entry in entries.items():
            labels = ((entry.get("frame_ann") or {}).get("labels")) or []
            rows = [(int(FPS * float(x["start_t"])), int(FPS * float(x["end_t"])), x) for x in labels]
            rows = sorted((a, b, str(x.get("proc_label") or x["raw_label"]).strip()) for a, b, x in rows if a < b)
            found[str(entry.get("name", name))] = rows
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path} is no BABEL file ({type(error).__name__}: {error})") from error
    return found


def write_folder(sets: dict[str, MotionDataset], out: str | Path, force: bool = False) -> Path:
    """Write splits into a folder in HumanML3D's layout; it appears whole or not at all.

    FileExistsError when the folder exists and `force` is false, FileNotFoundError when its parent does not.
    """
    out = check_new_folder(out, force)
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.resolve().parent))
    try:
        os.chmod(scratch, 0o755)
        for name in ("new_joint_vecs", "texts"):
            (scratch / name).mkdir()
        with open(scratch / "programs.jsonl", "w", encoding="utf-8", newline="\n") as lines:
            for split, data in sets.items():
                _write(scratch / f"{split}.txt", "".join(f"{clip.name}\n" for clip in data.clips))
                for clip in data.clips:
                    np.save(scratch / "new_joint_vecs" / f"{clip.name}.npy", clip.features, allow_pickle=False)
                    rows = "".join(f"{text}#{_tokens(text)}#0.0#0.0\n" for text in clip.captions)
                    _write(scratch / "texts" / f"{clip.name}.txt", rows)
                    if clip.program is not None:
                        record = {"name": clip.name, "kind": clip.kind, "asked": _plain(clip.program)}
                        record |= {"realised": _plain(clip.realised), "labels": clip.labels}
                        lines.write(json.dumps(record) + "\n")
        if not (scratch / "programs.jsonl").stat().st_size:
            (scratch / "programs.jsonl").unlink()
        first = sets.get("train") or next(iter(sets.values()))
        np.save(scratch / "Mean.npy", first.mean)
        np.save(scratch / "Std.npy", first.std)
        _write(scratch / "fingerprint.txt", first.fingerprint + "\n")
        if out.exists() and force:
            shutil.rmtree(out)
        try:
            scratch.rename(out)
        except OSError as error:
            if out.is_dir():  # somebody else made it meanwhile
                raise FileExistsError(f"{out} exists; give --force to replace it") from error
            raise
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return out


def check_new_folder(out: str | Path, force: bool = False) -> Path:
    """The folder as a Path if it can be made. FileExistsError, FileNotFoundError as `write_folder`."""
    out = Path(out)
    if out.exists() and not force:
        raise FileExistsError(f"{out} exists; give --force to replace it")
    if not out.resolve().parent.is_dir():
        raise FileNotFoundError(f"the folder {out.resolve().parent} does not exist")
    return out


def clip_records(folder: Path, split: str) -> dict[str, dict]:
    """What is known of clips beside features and captions: programs of the toy world, or BABEL's labels."""
    if (path := folder / "programs.jsonl").is_file():
        try:
            records = {record["name"]: record for record in map(json.loads, _text(path).splitlines())}
            for record in records.values():  # tried here, where the file can be named
                _program(record.get("asked")), _program(record.get("realised"))
                [(range(start, end), text.strip()) for start, end, text in record.get("labels", [])]
            return records
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path} is no list of programs ({error})") from error
    if (path := folder / f"{split}.json").is_file():
        return {name: {"labels": labels} for name, labels in babel_labels(path).items()}
    return {}


def read_statistics(folder: Path, width: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean.npy and Std.npy (width,), or None where one is missing. ValueError: another width, not finite, no spread."""
    paths = [folder / "Mean.npy", folder / "Std.npy"]
    if not all(path.is_file() for path in paths):
        return None
    mean, std = (_array(path) for path in paths)
    for path, value in zip(paths, (mean, std)):
        if value.shape != (width,) or value.dtype.kind != "f" or not np.isfinite(value).all():
            raise ValueError(f"{path}: expected {width} finite numbers, got {value.dtype} of shape {value.shape}")
    if (std <= 0).any():
        raise ValueError(f"{paths[1]}: every std is above 0, and that of feature {int(std.argmin())} is {std.min()}")
    return mean.astype(np.float32), std.astype(np.float32)


def _array(path: Path) -> np.ndarray:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, *NO_NPY) as error:
        raise ValueError(f"{path} is no whole .npy file of numbers ({' '.join(str(error).split())})") from error
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{path} is an archive (.npz), and one array (.npy) was expected")
    return array


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8") from error


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _tokens(text: str) -> str:
    """HumanML3D stores each caption's words with a part of speech; ours is not tagged."""
    return " ".join(f"{word}/OTHER" for word in text.replace(",", "").replace(".", "").split())


def _plain(program: Program | None) -> list[dict] | None:
    return None if program is None else [asdict(segment) for segment in program]


def _program(records: list[dict] | None) -> Program | None:
    return None if records is None else tuple(Segment(**record) for record in records)
