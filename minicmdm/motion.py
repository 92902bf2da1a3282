"""A motion: joints in space, the features they came from, and the sentence they act out."""

from __future__ import annotations

import html
import math
import tempfile
import webbrowser
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minicmdm.files import NO_NPY, check_output, whole_file

ENDINGS = (".npy", ".gif", ".html", ".bvh")


@dataclass
class Motion:
    """Joints (T,22,3), of KIT-ML (T,21,3), float32 in metres (Y up, facing +Z), features (T,D), caption, frame rate."""

    joints: np.ndarray
    features: np.ndarray | None = None
    caption: str = ""
    fps: float = 20

    def __len__(self) -> int:
        return len(self.joints)

    @property
    def seconds(self) -> float:
        """How long the motion lasts."""
        return len(self) / self.fps

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write .npy (the joints), .gif, .html (a player) or .bvh as one whole file, and return its path.

        Raises ValueError, FileNotFoundError, FileExistsError or PermissionError as `files.check_output` does.
        """
        path = check_output(path, ENDINGS, force)
        ending = path.suffix.lower()
        if ending == ".bvh":
            from minicmdm.data.bvh_out import write_bvh

            return write_bvh(path, self.joints, self.fps, force)
        with whole_file(path) as temporary:
            if ending == ".npy":
                with open(temporary, "wb") as file:
                    np.save(file, self.joints.astype(np.float32), allow_pickle=False)
            elif ending == ".gif":
                from minicmdm.viz.plots import save_gif

                save_gif(self.joints, temporary, caption=self.caption, fps=self.fps)
            else:
                temporary.write_text(self.to_html(), encoding="utf-8")
        return path

    def to_html(self) -> str:
        """A whole HTML page with the player in it, which needs no network."""
        from minicmdm.viz.player import html_page

        return html_page([self.joints], [self.caption], fps=self.fps)

    def show(self) -> object:
        """In a notebook, return the player as the cell's output; elsewhere open it in the browser."""
        if _in_notebook():
            try:
                from minicmdm.viz.widgets import SkeletonPlayer

                return SkeletonPlayer([self.joints], [self.caption], self.fps)
            except ImportError:  # without the notebooks extra: the page in a frame, which no saved notebook shows
                from IPython.display import HTML

                page = html.escape(self.to_html())
                return HTML(f'<iframe srcdoc="{page}" width="100%" height="480" style="border:0"></iframe>')
        page = self.to_html()
        with tempfile.NamedTemporaryFile("w", suffix=".html", delete=False, encoding="utf-8") as file:
            file.write(page)
        webbrowser.open(Path(file.name).as_uri())
        return None


def _in_notebook() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    shell = get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def load_joints(path: str | Path) -> np.ndarray:
    """Read joints (T,22,3), or KIT-ML's (T,21,3), in metres from an .npy file, as float64.

    Raises FileNotFoundError, or ValueError for a cut file, pickled objects, another shape, numbers that are not finite.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder: an .npy file of joints (T,22,3) was expected")
    if not path.exists():
        raise FileNotFoundError(f"no file {path}: an .npy file of joints (T,22,3) was expected")
    if not path.is_file():
        raise ValueError(f"{path} is not a regular file: an .npy file of joints (T,22,3) was expected")
    try:
        # Mapped, so that a header which promises more than the file holds is refused before memory is asked for.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except NO_NPY as error:
        raise ValueError(f"{path} is not a whole .npy file of numbers ({' '.join(str(error).split())})") from error
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{path} is an archive (.npz): an .npy file of joints (T,22,3) was expected")
    if array.ndim == 2 and array.shape[1] in (263, 251):
        raise ValueError(f"{path} holds features {array.shape}: features_to_joints makes the joints (T,22,3) asked for")
    if array.ndim != 3 or array.shape[1:] not in ((22, 3), (21, 3)) or len(array) == 0:
        raise ValueError(f"{path} must hold joints (T,22,3) in metres, and its shape is {array.shape}")
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{path} must hold real numbers, and its type is {array.dtype}")
    joints = np.array(array, dtype=np.float64)
    if not np.isfinite(joints).all():
        frame = int(np.argwhere(~np.isfinite(joints))[0, 0])
        raise ValueError(f"{path} holds a NaN or an infinity, first in frame {frame}")
    if (worst := np.abs(joints).max()) > 1e4:
        raise ValueError(
            f"{path} must be in metres, and its largest number is {worst:.3g}: {math.ceil(worst / 1e3)} km"
        )
    return joints
