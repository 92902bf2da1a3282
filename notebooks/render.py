"""Run the notebooks at full size and store their outputs, or take the outputs out.

    python notebooks/render.py [FILE ...]           run and store (all notebooks, unless some are named)
    python notebooks/render.py --strip [FILE ...]   remove every output

A copy is run, and what it gives is written only if no cell failed and none wrote to stderr. The outputs are normalised,
so that a second run gives the same file: no time stamps, no widget state (that is what breaks notebooks on GitHub), no
widget views but the picture that stands in for them, no memory addresses, cells counted from 1. The hash of the source
is stamped into the metadata: tests/test_notebooks.py refuses outputs that are older than the cells above them.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import re
import sys
from base64 import b64decode, b64encode
from pathlib import Path

FOLDER = Path(__file__).parent
MAX_DPI, MAX_WIDTH, COLOURS = 80, 1100, 128  # of a stored picture
WIDGET_VIEW = "application/vnd.jupyter.widget-view+json"
KEPT = ("image/png", "text/html", "text/markdown", "text/latex", "text/plain")


class Refused(Exception):
    """Outputs that must not be stored, with the cell and the reason."""


def source_hash(notebook: dict) -> str:
    """A hash of what a reader would run and read: every cell's id, type and source."""
    cells = [[cell["id"], cell["cell_type"], "".join(cell["source"])] for cell in notebook["cells"]]
    return hashlib.sha256(json.dumps(cells, ensure_ascii=False).encode()).hexdigest()[:16]


def strip(notebook: dict) -> dict:
    """Remove outputs, counts and every piece of metadata that a run or an editor leaves. Changes and returns it."""
    for cell in notebook["cells"]:
        cell["metadata"] = {key: cell["metadata"][key] for key in ("tags",) if key in cell["metadata"]}
        if cell["cell_type"] == "code":
            cell["outputs"], cell["execution_count"] = [], None
    own = {key: value for key, value in notebook["metadata"].get("minicmdm", {}).items() if key != "source"}
    notebook["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "minicmdm": own,
    }
    return notebook


def normalise(executed: dict) -> dict:
    """Outputs of a run made fit to be stored, and stamped. Changes and returns it. Refused: see `_output`."""
    outputs = {cell["id"]: cell["outputs"] for cell in executed["cells"] if cell["cell_type"] == "code"}
    stamp = source_hash(executed)
    strip(executed)
    count = 0
    for cell in executed["cells"]:
        if cell["cell_type"] == "code" and "".join(cell["source"]).strip():
            count += 1
            cell["execution_count"] = count
            for output in outputs[cell["id"]]:
                output, before = _output(output, cell["id"], count), cell["outputs"][-1:]
                if before and before[0]["output_type"] == output["output_type"] == "stream":
                    before[0]["text"] += output["text"]  # how a kernel cuts its text is chance
                else:
                    cell["outputs"].append(output)
    executed["metadata"]["minicmdm"]["source"] = stamp
    return executed


def _output(output: dict, cell: str, count: int) -> dict:
    if output["output_type"] == "error":
        raise Refused(f"cell {cell}: {output['ename']}: {output['evalue']}")
    if output["output_type"] == "stream":
        if output["name"] == "stderr":
            raise Refused(f"cell {cell} wrote to stderr: {''.join(output['text']).strip()}")
        return {"output_type": "stream", "name": "stdout", "text": _plain("".join(output["text"]))}
    data = {kind: value for kind, value in output["data"].items() if kind in KEPT}
    if WIDGET_VIEW in output["data"] and "image/png" not in data:
        raise Refused(f"cell {cell}: this widget has no picture for readers without a kernel")
    if not data:
        raise Refused(f"cell {cell}: none of {', '.join(output['data'])} can be stored")
    if "image/png" in data:
        data["image/png"] = _picture("".join(data["image/png"]), cell)
    data = {kind: value if kind == "image/png" else _plain("".join(value)) for kind, value in data.items()}
    result = {"output_type": output["output_type"], "data": data, "metadata": {}}
    return result | ({"execution_count": count} if output["output_type"] == "execute_result" else {})


def _plain(text: str) -> str:
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _picture(encoded: str, cell: str) -> str:
    """A picture (PNG in base64) with a palette instead of full colour, which is a third of the size."""
    from PIL import Image

    with Image.open(io.BytesIO(b64decode(encoded))) as picture:
        dpi = max(picture.info.get("dpi", (0, 0)))
        if dpi > MAX_DPI + 0.5 or picture.width > MAX_WIDTH:
            raise Refused(
                f"cell {cell}: a picture of {picture.width} pixels at {dpi:.0f} dpi, and the most is "
                f"{MAX_WIDTH} pixels at {MAX_DPI} dpi"
            )
        small = io.BytesIO()
        reduced = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        reduced.save(small, "PNG", optimize=True)
    return b64encode(small.getvalue()).decode("ascii")


def run(notebook: dict, folder: Path, timeout: int = 180) -> dict:
    """Execute a copy of the notebook with `folder` as its working directory. Refused: a cell failed."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError

    environment = {key: value for key, value in os.environ.items() if key != "MINICMDM_FAST"}  # always at full size
    environment |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    copy = nbformat.from_dict(strip(json.loads(json.dumps(notebook))))
    client = NotebookClient(
        copy, timeout=timeout, store_widget_state=False, record_timing=False, resources={"metadata": {"path": folder}}
    )
    try:
        client.execute(env=environment)
    except (CellExecutionError, CellTimeoutError) as error:
        raise Refused(str(error)) from error
    return copy


def read(path: Path) -> dict:
    """Read a notebook, sources as strings."""
    import nbformat

    return nbformat.reads(path.read_text(encoding="utf-8"), as_version=4)


def write(path: Path, notebook: dict) -> None:
    """Write the notebook as Jupyter does (sources as lists of lines), as one whole file."""
    import nbformat

    from minicmdm.files import write_text

    notebook = nbformat.from_dict(notebook)
    nbformat.validate(notebook)
    write_text(path, nbformat.writes(notebook).rstrip("\n") + "\n")


def main(arguments: list[str] | None = None) -> int:
    """Render or strip the named notebooks, or all; 1 if one was refused (and left as it was)."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--strip", action="store_true", help="remove outputs instead")
    chosen = parser.parse_args(arguments)
    failed = 0
    for path in chosen.files or sorted(FOLDER.glob("[0-9]*.ipynb")):
        notebook = read(path)
        try:
            write(path, strip(notebook) if chosen.strip else normalise(run(notebook, path.parent)))
            print(f"{path.name}: {'stripped' if chosen.strip else 'rendered'}, {path.stat().st_size / 1000:.0f} kB")
        except Refused as error:
            failed += 1
            print(f"{path.name}: refused and left as it was. {error}", file=sys.stderr)
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
