"""Motions with words, read from a folder in HumanML3D's layout or made from the toy world.

    folder/new_joint_vecs/NAME.npy   (T, 263) features
    folder/texts/NAME.txt            one "caption#tokens#start#end" a line
    folder/train.txt val.txt test.txt  names of each split
    folder/Mean.npy Std.npy          (263,)
    folder/programs.jsonl            toy data only: the program behind each clip and a sentence for each of its segments

The same reader loads the committed sample in data_toy/, a generated set and a real HumanML3D folder.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from minicmdm.data import body, grammar, moves, oracle, programs, synthesis
from minicmdm.data.features import canonicalize, joints_to_features
from minicmdm.data.programs import (
    HELDOUT_PAIRS,
    MAX_FRAMES,
    MIN_FRAMES,
    Program,
    Segment,
    pairs_of,
    sample_program,
)

SPLITS = {"train": 4096, "val": 256, "test": 1024}  # clips of the toy set
KINDS = (
    "ordinary",
    "paraphrase",
    "pairs",
)  # in the test: half ordinary, a quarter new phrases, a quarter new pairs
_GROUPS = [(0, 1), (1, 3), (3, 4), (4, 67), (67, 193), (193, 259), (259, 263)]  # features that share one Std


@dataclass(frozen=True)
class Clip:
    """One motion and its words: features (T, 263), captions, and for each segment (start, end, sentence) in frames."""

    name: str
    features: np.ndarray
    captions: list[str]
    labels: list[tuple[int, int, str]]
    program: Program | None = None  # what was asked; None for real data
    realised: Program | None = None  # what was acted, with every field, start and end
    kind: str = "ordinary"


@dataclass(frozen=True)
class MotionDataset:
    """Clips of one split with the normalisation of their folder: mean and std (263,)."""

    clips: list[Clip]
    mean: np.ndarray
    std: np.ndarray
    fingerprint: str

    def __len__(self) -> int:
        return len(self.clips)


def world_fingerprint() -> str:
    """A hash of the sources that make the toy world and its oracle: two numbers compare only under the same one."""
    sources = (programs, grammar, moves, synthesis, body, oracle, make_clip)
    text = "".join(inspect.getsource(source) for source in sources)
    return hashlib.sha256(text.replace("\r\n", "\n").encode()).hexdigest()[:16]


# --- the toy world ------------------------------------------------------------------------------------------------


def make_clip(split: str, index: int, program: Program | None = None) -> Clip:
    """Clip number `index` of a split, the same on every machine; `program` acts out a given one afresh."""
    rng = np.random.default_rng([sorted(SPLITS).index(split), index])
    kind = KINDS[(0, 1, 0, 2)[index % 4]] if split == "test" else "ordinary"
    for _ in range(1000):
        asked = program or sample_program(rng, heldout=kind == "pairs")
        performance = synthesis.synthesise(asked, rng)
        if performance is not None:
            break
    else:
        raise ValueError(f"this program does not fit into {MAX_FRAMES} frames: {asked}")
    features = joints_to_features(canonicalize(performance.joints)).astype(np.float32)  # (T, 263)
    new_words = kind == "paraphrase"
    captions = [grammar.caption(rng, asked, heldout=new_words) for _ in range(3)]
    starts = [0, *(s.start for s in performance.program[1:])]
    ends = [*starts[1:], len(features)]
    labels = [(a, b, grammar.sentence(rng, s, heldout=new_words)) for a, b, s in zip(starts, ends, asked)]
    return Clip(f"{split}_{index:05d}", features, captions, labels, asked, performance.program, kind)


def toy_dataset(split: str = "train", count: int | None = None, progress: bool = False) -> MotionDataset:
    """The first `count` clips of a toy split (all by default), made in memory: about 5 ms a clip.

    Mean and std are those of the clips made; a trained model carries its own. Raises ValueError on an unknown split.
    """
    if split not in SPLITS:
        raise ValueError(f"expected a split out of {', '.join(SPLITS)}, got {split!r}")
    numbers = range(SPLITS[split] if count is None else min(count, SPLITS[split]))
    if progress:
        from tqdm import tqdm

        numbers = tqdm(numbers, desc=f"making toy {split}", unit="clip")
    clips = [make_clip(split, i) for i in numbers]
    mean, std = feature_statistics([clip.features for clip in clips])
    return MotionDataset(clips, mean, std, world_fingerprint())


def feature_statistics(features: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std (263,) over all frames; the std averaged within each group of features, as HumanML3D's is."""
    stacked = np.concatenate(features).astype(np.float64)
    mean, std = stacked.mean(0), stacked.std(0)
    for a, b in _GROUPS:
        std[a:b] = max(std[a:b].mean(), 1e-4)
    return mean.astype(np.float32), std.astype(np.float32)


# --- folders ------------------------------------------------------------------------------------------------------


def make_folder(
    out: str | Path, counts: dict[str, int] | None = None, force: bool = False, progress: bool = True
) -> Path:
    """Write the toy set into a folder in HumanML3D's layout; it appears whole or not at all.

    `counts` maps splits to numbers of clips (default: 4,096 / 256 / 1,024). Raises FileExistsError when the folder
    exists and `force` is false, FileNotFoundError when its parent does not.
    """
    out = Path(out)
    if out.exists() and not force:
        raise FileExistsError(f"{out} exists; give --force to replace it")
    if not out.resolve().parent.is_dir():
        raise FileNotFoundError(f"the folder {out.resolve().parent} does not exist")
    sets = {split: toy_dataset(split, count, progress) for split, count in (counts or SPLITS).items()}
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.resolve().parent))
    try:
        os.chmod(scratch, 0o755)
        for name in ("new_joint_vecs", "texts"):
            (scratch / name).mkdir()
        with open(scratch / "programs.jsonl", "w", encoding="utf-8", newline="\n") as lines:
            for split, data in sets.items():
                (scratch / f"{split}.txt").write_text("".join(f"{c.name}\n" for c in data.clips), encoding="utf-8")
                for clip in data.clips:
                    np.save(scratch / "new_joint_vecs" / f"{clip.name}.npy", clip.features, allow_pickle=False)
                    rows = "".join(f"{text}#{_tokens(text)}#0.0#0.0\n" for text in clip.captions)
                    (scratch / "texts" / f"{clip.name}.txt").write_text(rows, encoding="utf-8")
                    record = {
                        "name": clip.name,
                        "kind": clip.kind,
                        "asked": _plain(clip.program),
                        "realised": _plain(clip.realised),
                    }
                    lines.write(json.dumps({**record, "labels": clip.labels}) + "\n")
        first = sets.get("train") or next(iter(sets.values()))
        np.save(scratch / "Mean.npy", first.mean)
        np.save(scratch / "Std.npy", first.std)
        (scratch / "fingerprint.txt").write_text(first.fingerprint + "\n", encoding="utf-8")
        if out.exists():
            shutil.rmtree(out)
        os.replace(scratch, out)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return out


def load_dataset(folder: str | Path, split: str = "train") -> MotionDataset:
    """Read one split of a folder in HumanML3D's layout.

    Clips outside 40 to 196 frames are left out (HumanML3D's own rule; longer ones are cut). Raises FileNotFoundError
    for a missing folder, split or clip and ValueError for features of another width or that are not finite.
    """
    folder = Path(folder)
    listing = folder / f"{split}.txt"
    if not listing.is_file():
        raise FileNotFoundError(f"no {split}.txt in {folder}: expected a folder in HumanML3D's layout")
    names = [line.strip() for line in listing.read_text(encoding="utf-8").splitlines() if line.strip()]
    extra = {}
    if (folder / "programs.jsonl").is_file():
        with open(folder / "programs.jsonl", encoding="utf-8") as lines:
            extra = {record["name"]: record for record in map(json.loads, lines)}
    clips = []
    for name in names:
        path = folder / "new_joint_vecs" / f"{name}.npy"
        if not path.is_file():
            raise FileNotFoundError(f"{listing} names {name}, but {path} is not there")
        features = np.load(path, allow_pickle=False).astype(np.float32)
        if features.ndim != 2 or features.shape[1] != 263 or not np.isfinite(features).all():
            raise ValueError(f"{path}: expected finite features of shape (T, 263), got shape {features.shape}")
        if len(features) < MIN_FRAMES:
            continue
        rows = (folder / "texts" / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        captions = [row.split("#")[0].strip() for row in rows if row.split("#")[0].strip()]
        more = extra.get(name, {})
        clips.append(
            Clip(
                name,
                features[:MAX_FRAMES],
                captions,
                [tuple(label) for label in more.get("labels", [])],
                _program(more.get("asked")),
                _program(more.get("realised")),
                more.get("kind", "ordinary"),
            )
        )
    if (folder / "Mean.npy").is_file() and (folder / "Std.npy").is_file():
        mean, std = (np.load(folder / f, allow_pickle=False).astype(np.float32) for f in ("Mean.npy", "Std.npy"))
    else:
        mean, std = feature_statistics([clip.features for clip in clips])
    note = folder / "fingerprint.txt"
    return MotionDataset(clips, mean, std, note.read_text(encoding="utf-8").strip() if note.is_file() else "")


def cached_toy_folder(progress: bool = True) -> Path:
    """The whole toy set on disk (about 0.7 GB), made once, in ~/.cache/minicmdm or `MINICMDM_CACHE`."""
    root = Path(os.environ.get("MINICMDM_CACHE") or Path.home() / ".cache" / "minicmdm")
    root.mkdir(parents=True, exist_ok=True)
    folder = root / f"toy-{world_fingerprint()}"
    return folder if folder.is_dir() else make_folder(folder, progress=progress)


def _tokens(text: str) -> str:
    """HumanML3D stores each caption's words with a part of speech; ours is not tagged."""
    return " ".join(f"{word}/OTHER" for word in text.replace(",", "").replace(".", "").split())


def _plain(program: Program) -> list[dict]:
    return [asdict(segment) for segment in program]


def _program(records: list[dict] | None) -> Program | None:
    return None if records is None else tuple(Segment(**record) for record in records)


def unseen_pairs(clip: Clip) -> bool:
    """True when the clip's program holds a pair of neighbours that no training program holds."""
    return clip.program is not None and any(pair in HELDOUT_PAIRS for pair in pairs_of(clip.program))
