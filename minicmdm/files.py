"""Writing files so that nobody ever meets half of one.

Everything minicmdm writes goes to a temporary name in the same folder first, is pushed to the disk, and only then takes
its real name in one atomic step. Whoever pulls the plug finds the old file or the new one, and never a mixture.
"""

from __future__ import annotations

import os
import tempfile
import tokenize
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# All that numpy raises for a file that is no whole .npy: its header is parsed as Python text.
NO_NPY = (ValueError, EOFError, OverflowError, SyntaxError, MemoryError, TypeError, RecursionError, tokenize.TokenError)


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Lend a temporary name (same folder, same ending) that becomes `path` if the block ends well, else vanishes."""
    path = Path(path)
    temporary = path.with_name(f".minicmdm-{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # the bytes first ...
        os.replace(temporary, path)  # ... then the name: after a power cut the name never points at nothing
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text (with \\n line ends on every system) as one whole file."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def cache_folder() -> Path:
    """Where what can be made again is kept: ~/.cache/minicmdm, or `MINICMDM_CACHE`. It need not exist."""
    return Path(os.environ.get("MINICMDM_CACHE") or Path.home() / ".cache" / "minicmdm")


def check_output(path: str | Path, endings: tuple[str, ...], force: bool = False) -> Path:
    """Say before any work is done whether `path` can be written; return it as a Path.

    Raises ValueError (a folder, an unknown ending), FileNotFoundError (no such parent folder), FileExistsError (it is
    there and `force` is off) or PermissionError (the folder takes no files).
    """
    known = ", ".join(endings)
    if not str(path).strip():
        raise ValueError(f"the output name is empty: give a file that ends in one of {known}")
    text, path = str(path), Path(path)
    if path.is_dir() or text.endswith(("/", os.sep)):
        raise ValueError(f"the output {text} is a folder: give a file name in it that ends in one of {known}")
    if path.suffix.lower() not in endings:
        raise ValueError(f"the output {text} must end in one of {known}, and it ends in {path.suffix or 'nothing'}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} for the output {path.name} does not exist: make it first")
    if path.exists() and not force:
        raise FileExistsError(
            f"the output {text} exists already and was left as it is: --force (force=True) replaces it"
        )
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise PermissionError(f"the folder {path.parent} takes no files: {error.strerror or error}") from error
    return path
