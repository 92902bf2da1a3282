"""Every notebook keeps to the course's standard, and its stored outputs are complete and fresh, or absent.

`problems` says what is wrong with a notebook. Each rule is tested too: a notebook spoilt in one way must be caught.
"""

import importlib.util
import io
import json
import re
import statistics
from base64 import b64decode
from pathlib import Path

import nbformat
import pytest
from PIL import Image

from minicmdm.exercises import EXERCISES

FOLDER = Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("[0-9]*.ipynb"))

_spec = importlib.util.spec_from_file_location("render", FOLDER / "render.py")
render = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(render)

FORBIDDEN_CODE = {
    r"\binteract(ive)?\(": "raw interact: use minicmdm.viz.widgets.explore",
    r"MINICMDM_FAST": "fast mode belongs to whoever runs the gates",
    r"^\s*[!%]": "shell and magic commands",
    r"urlretrieve|requests\.|hf_hub_download|snapshot_download|wget|curl ": "downloads",
    r"cuda": "a GPU is never assumed",
    r"\.\./": "paths out of the notebook's folder",
    r"tqdm\.(auto|notebook)": "bars that are widgets",
}
SECTIONS = [
    r"^# \d\d · \S",
    r"^\*\*After this you can\*\*",
    r"^## .*Exercises",
    r"^## Where the papers? and (its|their) released code differ",
    r"^## You can now",
    r"^## Self-quiz",
    r"^## Three changes to try",
    r"^## Next",
]
WIDGET = re.compile(
    r"\bexplore\(|SkeletonPlayer\(|MotionMaker\(|MatrixExplorer\(|NoisePainter\(|LiveStream\(|(?<!plt)\.show\(\)"
)
FIGURE = re.compile(r"\bpicture\(|pose_strip\(|strips\(|plt\.show\(|imshow\(|plt\.subplots\(")


def source(cell):
    return "".join(cell["source"])


def of(notebook, kind):
    return [cell for cell in notebook["cells"] if cell["cell_type"] == kind]


def prose(notebook):
    """Its words, as a reader counts them: no markup, no formulas, no addresses."""
    text = "\n".join(source(cell) for cell in of(notebook, "markdown"))
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$|```.*?```|<[^>]+>|\]\([^)]*\)", " ", text, flags=re.S)
    return re.findall(r"[^\W_][\w'’-]*", text)


def problems(notebook, name, size=0):
    """What breaks the standard, in words; an empty list if nothing does."""
    return [*_size(notebook, size), *_order(notebook, name), *_contents(notebook, name), *_storage(notebook)]


def _size(notebook, size):
    code, markdown = of(notebook, "code"), of(notebook, "markdown")
    lines = [len([line for line in source(cell).splitlines() if line.strip()]) for cell in code]
    words, share = len(prose(notebook)), len(markdown) / len(notebook["cells"])
    for what, value, low, high in [
        ("cells", len(notebook["cells"]), 35, 55),
        ("share of prose cells", share, 0.5, 0.6),
        ("words of prose", words, 1000, 1800),
        ("lines of code", sum(lines), 150, 250),
        ("median lines of a code cell", statistics.median(lines), 1, 9),
        ("lines of the longest code cell", max(lines), 1, 40),
        ("bytes", size, 0, 400_000),
    ]:
        if not low <= value <= high:
            yield f"{value:.5g} {what}, and {low} to {high} are allowed"


def _order(notebook, name):
    number, cells = name[:2], notebook["cells"]
    header = source(cells[0]) if cells[0]["cell_type"] == "markdown" else ""
    if not header.startswith(f"# {number} · "):
        yield f"the first cell is no header: '# {number} · title'"
    for row in ("needs", "gives", "paper", "read", "run"):
        if not re.search(rf"^\| \*\*{row}\*\* \| \S", header, re.M):
            yield f"the header table lacks the row {row}"
    objectives = next((source(cell) for cell in cells if "**After this you can**" in source(cell)), "")
    if not 3 <= len(re.findall(r"^\* ", objectives, re.M)) <= 5:
        yield "three to five lines say what the reader can do afterwards"
    markdown = [source(cell) for cell in of(notebook, "markdown")]
    places = [next((i for i, text in enumerate(markdown) if re.search(p, text, re.M)), None) for p in SECTIONS]
    for pattern, place in zip(SECTIONS, places):
        if place is None:
            yield f"no section {pattern}"
    if (found := [place for place in places if place is not None]) != sorted(found):
        yield "the sections are out of order"
    asked = [i for i, cell in enumerate(cells) if cell["cell_type"] == "markdown" and "**Predict" in source(cell)]
    if len(asked) < 3:
        yield f"{len(asked)} predictions are asked for, and at least 3 belong in a notebook"
    for i in asked:
        if i + 1 == len(cells) or cells[i + 1]["cell_type"] != "code":
            yield f"cell {cells[i]['id']}: a prediction is followed by the cell that shows"
    quiz = next((text for text in markdown if "## Self-quiz" in text), "")
    if quiz.count("<details>") < 4 or quiz.count("<details>") != quiz.count("</details>"):
        yield "the self-quiz has at least four questions, their answers folded in <details>"
    changes = next((text for text in markdown if "## Three changes" in text), "")
    if re.findall(r"^(\d)\. ", changes, re.M) != ["1", "2", "3"]:
        yield "three changes to try are numbered 1 to 3"


def _contents(notebook, name):
    code = of(notebook, "code")
    for cell in code:
        for pattern, why in FORBIDDEN_CODE.items():
            if re.search(pattern, source(cell), re.M):
                yield f"cell {cell['id']}: {why}"
    for i, cell in enumerate(code):
        if WIDGET.search(source(cell)) and not (i and FIGURE.search(source(code[i - 1]))):
            yield f"cell {cell['id']}: no static figure comes before this widget"
    for cell in of(notebook, "markdown"):
        if cell.get("attachments") or re.search(r"!\[[^\]]*\]\(|<img|<iframe|<script", source(cell)):
            yield f"cell {cell['id']}: pictures and frames are not kept in prose"
        for link in re.findall(r"\]\(([^)#]+)", source(cell)):
            if not link.startswith(("http://", "https://")) and not (FOLDER / link).exists():
                yield f"cell {cell['id']}: the link {link} leads nowhere"
    text = "\n".join(source(cell) for cell in code)
    checked, own = re.findall(r'check\("([\d.]+)"', text), [id for id in EXERCISES if id.startswith(name[:2] + ".")]
    if checked != own:
        yield f"exercises {checked} are checked, and the library has {own}"
    for cell in code:
        if "check(" in source(cell) and "..." not in source(cell):
            yield f"cell {cell['id']}: this exercise is solved"


def _storage(notebook):
    metadata, ids = notebook["metadata"], [cell.get("id", "") for cell in notebook["cells"]]
    if notebook["nbformat"] != 4 or notebook["nbformat_minor"] < 5 or len(set(ids)) != len(ids):
        yield "nbformat 4.5 with an id of its own for each cell is expected"
    else:
        try:
            nbformat.validate(nbformat.from_dict(notebook))
        except nbformat.ValidationError as error:
            yield f"not a valid notebook: {error.message}"
    if random := [id for id in ids if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", id) or _random(id)]:
        yield f"cell ids are short words, chosen once: {random}"
    if set(metadata) != {"kernelspec", "language_info", "minicmdm"} or metadata["language_info"] != {"name": "python"}:
        yield f"metadata is kernelspec, language_info (no version) and minicmdm, and {sorted(metadata)} came"
    if metadata["kernelspec"]["name"] != "python3":
        yield "the kernel is python3"
    if not 0 < metadata.get("minicmdm", {}).get("budget_s", 0) <= 300:
        yield "metadata.minicmdm.budget_s is the budget in CPU seconds, up to 300"
    yield from _outputs(notebook)


def _random(id):
    return re.fullmatch(r"[0-9a-f]{6,}", id) is not None  # what editors invent


def _outputs(notebook):
    code = [cell for cell in of(notebook, "code") if source(cell).strip()]
    counts, stamp = [cell["execution_count"] for cell in code], notebook["metadata"].get("minicmdm", {}).get("source")
    if any(set(cell["metadata"]) - {"tags"} for cell in notebook["cells"]):
        yield "cells carry no metadata but tags"
    if stamp is None:
        if any(counts) or any(cell["outputs"] for cell in code):
            yield "outputs without a stamp: only notebooks/render.py stores outputs"
        return
    if stamp != render.source_hash(notebook):
        yield "the outputs are older than the source: run notebooks/render.py"
    if counts != list(range(1, len(code) + 1)):
        yield f"cells are counted 1, 2, 3 ..., and {counts} came"
    for cell in code:
        for output in cell["outputs"]:
            data = output.get("data", {})
            if output["output_type"] == "error" or output.get("name") == "stderr":
                yield f"cell {cell['id']}: an error is stored"
            if render.WIDGET_VIEW in data or not set(data) <= set(render.KEPT):
                yield f"cell {cell['id']}: {sorted(data)} is stored"
            if " at 0x" in json.dumps(output):
                yield f"cell {cell['id']}: a memory address is stored"
            if "image/png" in data:
                picture = Image.open(io.BytesIO(b64decode("".join(data["image/png"]))))
                if picture.width > render.MAX_WIDTH or max(picture.info.get("dpi", (0,))) > render.MAX_DPI + 0.5:
                    yield f"cell {cell['id']}: a picture of {picture.width} pixels, {picture.info.get('dpi')} dpi"
        if WIDGET.search(source(cell)) and not any("image/png" in out.get("data", {}) for out in cell["outputs"]):
            yield f"cell {cell['id']}: the widget has no picture for readers without a kernel"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_keeps_the_standard(path):
    assert problems(render.read(path), path.name, path.stat().st_size) == []


# --- the rules are rules ----------------------------------------------------------------------------------------------


def start_here():
    return render.strip(render.read(FOLDER / "00_start_here.ipynb"))


def cell(notebook, id):
    return next(cell for cell in notebook["cells"] if cell["id"] == id)


def rendered():
    """Notebook 00 as if it had been run: a line of text from every cell, a small picture where one is due."""
    notebook = start_here()
    for one in of(notebook, "code"):
        one["outputs"] = [nbformat.v4.new_output("stream", name="stdout", text="fine\n")]
        if WIDGET.search(source(one)):
            view = {render.WIDGET_VIEW: {"model_id": "x"}, "image/png": picture_of(20), "text/plain": "<W at 0x7f>"}
            one["outputs"].append(nbformat.v4.new_output("execute_result", data=view, execution_count=77))
    return render.normalise(notebook)


def picture_of(width):
    out = io.BytesIO()
    Image.new("RGB", (width, 5), (9, 9, 9)).save(out, "PNG")
    return render.b64encode(out.getvalue()).decode()


def say(id, text):
    """Spoil a notebook by replacing a cell's source."""
    return lambda notebook: cell(notebook, id).update(source=text)


def append(id, text):
    return lambda notebook: cell(notebook, id).update(source=source(cell(notebook, id)) + text)


def drop(id):
    return lambda notebook: notebook["cells"].remove(cell(notebook, id))


def put_out(id, **output):
    return lambda notebook: cell(notebook, id)["outputs"].append(output)


SPOILT = [  # how, what must be said
    (say("title", "# Start here"), "no header"),
    (say("title", "# 01 · Start here"), "no header"),
    (lambda n: cell(n, "title").update(source=source(cell(n, "title")).replace("**run**", "**time**")), "row run"),
    (say("objectives", "**After this you can**\n\n* do it"), "three to five lines"),
    (drop("quiz"), "Self-quiz"),
    (lambda n: n["cells"].append(n["cells"].pop(0)), "first cell is no header"),
    (lambda n: n["cells"].insert(2, n["cells"].pop()), "out of order"),
    (append("player-question", " word" * 900), "words of prose"),
    (lambda n: [drop(c["id"])(n) for c in n["cells"][9:30]], "cells, and 35"),
    (append("strips", "\nx = 1" * 40), "longest code cell"),
    (lambda n: [append(c["id"], "\nx = 1" * 6)(n) for c in of(n, "code")], "median lines"),
    (drop("strip"), "no static figure"),
    (lambda n: n["cells"].remove(cell(n, "causal")), "followed by the cell that shows"),
    (append("film", "\ninteract(print, x=3)"), "raw interact"),
    (append("film", "\n!pip install x"), "shell and magic"),
    (append("film", '\npipe.dit.to("cuda")'), "GPU"),
    (append("film", '\nopen("../data_toy/x")'), "paths out of"),
    (append("film", '\nos.environ["MINICMDM_FAST"]'), "fast mode"),
    (append("film", "\nfrom tqdm.auto import tqdm"), "bars that are widgets"),
    (append("film", "\nurlretrieve(url)"), "downloads"),
    (append("schedule", "\n![x](https://example.org/x.png)"), "not kept in prose"),
    (append("schedule", "\n[x](99_nothing.ipynb)"), "leads nowhere"),
    (drop("exercise-2"), "are checked"),
    (say("exercise-2", 'check("00.2", lambda f: f // 4 * 4)'), "is solved"),
    (say("quiz", "## Self-quiz\n\nNone."), "self-quiz has"),
    (say("changes", "## Three changes to try\n\n1. One."), "numbered 1 to 3"),
    (lambda n: cell(n, "film").update(id="a1b2c3d4"), "cell ids"),
    (lambda n: cell(n, "film").update(id="strip"), "id of its own"),
    (lambda n: n["metadata"].update(widgets={}), "metadata is"),
    (lambda n: n["metadata"]["language_info"].update(version="3.11"), "no version"),
    (lambda n: n["metadata"]["minicmdm"].pop("budget_s"), "budget"),
    (put_out("film", output_type="stream", name="stdout", text="x"), "without a stamp"),
    (lambda n: cell(n, "film").update(execution_count=1), "without a stamp"),
]


@pytest.mark.parametrize(("spoil", "said"), SPOILT)
def test_a_spoilt_notebook_is_caught(spoil, said):
    notebook = start_here()
    assert problems(notebook, "00_start_here.ipynb") == []
    spoil(notebook)
    found = problems(notebook, "00_start_here.ipynb")
    assert any(re.search(said, problem) for problem in found), found


SPOILT_OUTPUTS = [
    (append("film", "\n"), "older than the source"),
    (append("title", "\nnew words"), "older than the source"),
    (lambda n: cell(n, "film").update(execution_count=99), "are counted"),
    (lambda n: cell(n, "film")["metadata"].update(execution={"x": "now"}), "no metadata but tags"),
    (put_out("film", output_type="stream", name="stderr", text="Warning"), "error is stored"),
    (put_out("film", output_type="error", ename="E", evalue="", traceback=[]), "error is stored"),
    (put_out("film", output_type="display_data", metadata={}, data={render.WIDGET_VIEW: {}}), "is stored"),
    (put_out("film", output_type="display_data", metadata={}, data={"text/plain": "<F at 0x7>"}), "address"),
    (put_out("film", output_type="display_data", metadata={}, data={"image/png": picture_of(2000)}), "2000 pixels"),
    (lambda n: cell(n, "player").update(outputs=[]), "has no picture"),
    (lambda n: n["metadata"]["minicmdm"].pop("source"), "without a stamp"),
]


@pytest.mark.parametrize(("spoil", "said"), SPOILT_OUTPUTS)
def test_spoilt_outputs_are_caught(spoil, said):
    notebook = rendered()
    assert problems(notebook, "00_start_here.ipynb") == []
    spoil(notebook)
    assert any(re.search(said, problem) for problem in problems(notebook, "00_start_here.ipynb"))


def test_a_heavy_notebook_is_caught():
    assert any("bytes" in problem for problem in problems(start_here(), "00_start_here.ipynb", 400_001))
