"""A data set's folder on one card, and file by file what is wrong with it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from minicmdm.data.folders import (
    SPLIT_NAMES,
    clip_records,
    cut_clips,
    other_width,
    read_captions,
    read_features,
    read_statistics,
    split_names,
)
from minicmdm.data.programs import MAX_FRAMES
from minicmdm.data.skeleton import SMPL22, skeleton_of


def inspect_folder(folder: str | Path) -> tuple[dict[str, object], list[str]]:
    """A data set's card, and what is wrong with it, file by file. FileNotFoundError: no folder, or no split in it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}: expected a data set in HumanML3D's layout")
    splits = [name for name in SPLIT_NAMES if (folder / f"{name}.txt").is_file()]
    if not splits:
        raise FileNotFoundError(f"{folder} holds none of {', '.join(f'{name}.txt' for name in SPLIT_NAMES)}")
    card: dict[str, object] = {"folder": str(folder)}
    wrong: list[str] = []
    seen: dict[str, str] = {}
    frames, captions, words = [], 0, set()
    first = None  # features: they say whose body all others must be

    def attempt(work: Callable):
        try:
            return work()
        except (ValueError, OSError) as error:
            wrong.append(" ".join(str(error).split()))

    for split in splits:
        names = attempt(lambda: split_names(folder, split)) or []  # noqa: B023
        card[split] = len(names)
        records = attempt(lambda: clip_records(folder, split)) or {}  # noqa: B023
        for name in names:
            if name in seen:
                wrong.append(f"{split}.txt names {name}, which {seen[name]}.txt has named already")
                continue
            seen[name] = split
            path = folder / "new_joint_vecs" / f"{name}.npy"
            features = attempt(lambda: read_features(path, f"{name} is in {split}.txt, but its file"))  # noqa: B023
            if features is None:
                continue
            first = features if first is None else first
            body = skeleton_of(features.shape[1])
            if strange := other_width(first, features):
                wrong.append(f"{path} {strange}")
            frames.append(len(features))
            if len(features) < body.min_frames:
                wrong.append(f"{path} has {len(features)} frames: those under {body.min_frames} are left out")
            elif len(features) > MAX_FRAMES:
                wrong.append(f"{path} has {len(features)} frames: what is over {MAX_FRAMES} is cut")
            texts = folder / "texts" / f"{name}.txt"
            said = attempt(lambda: read_captions(texts, len(features), body.fps))  # noqa: B023
            if said is not None:
                attempt(lambda: cut_clips(folder, name, features, said, records.get(name, {})))  # noqa: B023
                sentences = [*said[0], *(text for some in said[1].values() for text in some)]
                captions += len(sentences)
                words |= {word for text in sentences for word in re.findall(r"[^\W\d_]+", text.lower())}
    body = SMPL22 if first is None else skeleton_of(first.shape[1])
    attempt(lambda: read_statistics(folder, body.num_features))
    for name in ("Mean.npy", "Std.npy"):
        if not (folder / name).is_file():
            wrong.append(f"{folder / name} is not there: mean and std of the training clips are used")
    if frames:
        card |= {"features": body.num_features, "joints": body.num_joints, "fps": body.fps}
        card |= {"seconds": round(sum(frames) / body.fps, 1), "frames_least": min(frames), "frames_most": max(frames)}
    card |= {"captions": captions, "words": len(words), "problems": len(wrong)}
    return card, wrong
