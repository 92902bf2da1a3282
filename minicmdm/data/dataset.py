"""The toy data set: every clip is made from its world when it is asked for, the same on every machine."""

from __future__ import annotations

import hashlib
import inspect
from pathlib import Path

import numpy as np

from minicmdm.data import body, grammar, moves, oracle, programs, synthesis
from minicmdm.data.clips import Clip, MotionDataset, feature_statistics
from minicmdm.data.features import canonicalize, joints_to_features
from minicmdm.data.folders import check_new_folder, write_folder
from minicmdm.data.programs import (
    HELDOUT_PAIRS,
    MAX_FRAMES,
    Program,
    pairs_of,
    sample_program,
)
from minicmdm.files import cache_folder

SPLITS = {"train": 4096, "val": 256, "test": 1024}  # clips of the toy set
KINDS = (
    "ordinary",
    "paraphrase",
    "pairs",
)  # in the test: half ordinary, a quarter new phrases, a quarter new pairs


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


def make_folder(
    out: str | Path, counts: dict[str, int] | None = None, force: bool = False, progress: bool = True
) -> Path:
    """Write the toy set into a folder in HumanML3D's layout; it appears whole or not at all.

    `counts` maps splits to numbers of clips (default: 4,096 / 256 / 1,024). Raises as `folders.write_folder` does.
    """
    check_new_folder(out, force)
    sets = {split: toy_dataset(split, count, progress) for split, count in (counts or SPLITS).items()}
    return write_folder(sets, out, force)


def cached_toy_folder(progress: bool = True) -> Path:
    """The whole toy set on disk (about 0.7 GB), made once, in ~/.cache/minicmdm or `MINICMDM_CACHE`."""
    root = cache_folder()
    root.mkdir(parents=True, exist_ok=True)
    folder = root / f"toy-{world_fingerprint()}"
    if not folder.is_dir():
        try:
            make_folder(folder, progress=progress)
        except FileExistsError:  # another process was faster, and its folder is whole
            pass
    return folder


def unseen_pairs(clip: Clip) -> bool:
    """True when the clip's program holds a pair of neighbours that no training program holds."""
    return clip.program is not None and any(pair in HELDOUT_PAIRS for pair in pairs_of(clip.program))
