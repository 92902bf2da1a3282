"""The demo: three sentences, three motions, each as an HTML player and a GIF."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import Segment
from minicmdm.files import check_output
from minicmdm.motion import ENDINGS

# File name, sentence, frames, seed: chosen among those it gets right; `evaluate --quick` says how often.
SCENES = (
    ("walk_and_jump", "a person walks forward while waving the right hand, then jumps twice", 120, 0),
    ("clap_turn_run", "a child claps, then turns to the left and finally runs", 128, 0),
    ("spin_and_kick", "a dancer spins around to the right, then kicks with the left leg twice", 116, 1),
)


def outputs(folder: Path, force: bool) -> list[list[Path]]:
    """The files that the demo will write, an .html and a .gif a scene; the folder is made if its parent exists.

    Raises FileExistsError or FileNotFoundError before anything is written.
    """
    if folder.exists() and not folder.is_dir():
        raise FileExistsError(f"--out {folder} is a file: the demo writes a folder")
    if not folder.absolute().parent.is_dir():
        raise FileNotFoundError(f"the folder {folder.absolute().parent} for {folder.name} does not exist")
    folder.mkdir(exist_ok=True)
    return [[check_output(folder / (name + end), ENDINGS, force) for end in (".html", ".gif")] for name, *_ in SCENES]


def perform(files: list[list[Path]], force: bool) -> Iterator[tuple[str, list[Segment], list[Path]]]:
    """Generate and save scene after scene; yield its sentence, what the oracle reads in it, and its files."""
    from minicmdm.pipeline import MotionPipeline  # loads torch

    pipe = MotionPipeline.from_pretrained("toy")
    for (_, prompt, frames, seed), paths in zip(SCENES, files):
        motion = pipe(prompt, num_frames=frames, seed=seed)
        for path in paths:
            motion.save(path, force=force)
        yield prompt, read_motion(motion.joints), paths
