"""Rendering notebooks: what is stored, what is refused; and the budget of notebooks/conftest.py."""

import copy
import os
import re
import shutil
import subprocess
import sys

import nbformat
import pytest
from test_notebooks import FOLDER, cell, picture_of, render, rendered, start_here


def small_notebook(*sources, budget=60):
    cells = [nbformat.v4.new_code_cell(text, id=f"cell-{i}") for i, text in enumerate(sources)]
    return nbformat.v4.new_notebook(cells=cells, metadata={"minicmdm": {"budget_s": budget}})


def test_normalised_outputs_are_the_same_from_run_to_run():
    notebook = rendered()
    assert cell(notebook, "player")["outputs"][1]["execution_count"] == cell(notebook, "player")["execution_count"]
    assert set(cell(notebook, "player")["outputs"][1]["data"]) == {"image/png", "text/plain"}
    assert cell(notebook, "player")["outputs"][1]["data"]["text/plain"] == "<W>"
    again = copy.deepcopy(notebook)
    cell(again, "film")["outputs"] = [dict(cell(notebook, "film")["outputs"][0], text=part) for part in ("fi", "ne\n")]
    again["metadata"]["widgets"], again["metadata"]["language_info"]["version"] = {"state": 1}, "3.11"
    cell(again, "film")["metadata"], cell(again, "film")["execution_count"] = {"execution": {"t": 1}}, 5
    assert render.normalise(again) == notebook


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ({"output_type": "error", "ename": "ValueError", "evalue": "no", "traceback": []}, "film: ValueError: no"),
        ({"output_type": "stream", "name": "stderr", "text": "Warning: x"}, "film wrote to stderr: Warning: x"),
        ({"output_type": "display_data", "data": {render.WIDGET_VIEW: {}, "text/plain": "W()"}}, "no picture"),
        ({"output_type": "display_data", "data": {"application/pdf": "x"}}, "none of application/pdf"),
        ({"output_type": "display_data", "data": {"image/png": picture_of(1101)}}, "1101 pixels"),
    ],
)
def test_outputs_that_must_not_be_stored_are_refused(output, said):
    notebook = start_here()
    cell(notebook, "film")["outputs"] = [output]
    with pytest.raises(render.Refused, match=said):
        render.normalise(notebook)


def test_rendering_runs_a_copy_at_full_size_and_leaves_a_failed_notebook_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MINICMDM_FAST", "1")
    good, bad = tmp_path / "good.ipynb", tmp_path / "bad.ipynb"
    look = 'import os\nprint(os.environ.get("MINICMDM_FAST"), os.getcwd())'
    render.write(good, small_notebook(look, "object()"))
    render.write(bad, small_notebook("print(1)", "1 / 0"))
    before = bad.read_bytes()
    assert render.main([str(bad), str(good)]) == 1
    said = capsys.readouterr()
    assert "bad.ipynb: refused" in said.err and "ZeroDivisionError" in said.err and "good.ipynb: rendered" in said.out
    assert bad.read_bytes() == before
    notebook = render.read(good)
    outputs = [cell["outputs"][0] for cell in notebook["cells"]]
    assert outputs[0]["text"] == f"None {os.path.realpath(tmp_path)}\n"
    assert outputs[1]["data"]["text/plain"] == "<object>"
    assert notebook["metadata"]["minicmdm"] == {"budget_s": 60, "source": render.source_hash(notebook)}
    assert render.main(["--strip", str(good)]) == 0
    assert render.read(good)["cells"][0]["outputs"] == []


def test_a_notebook_over_its_budget_fails(tmp_path):
    shutil.copy(FOLDER / "conftest.py", tmp_path)
    burn = "import time\nstart = time.process_time()\nwhile time.process_time() < start + 1.5:\n    pass"
    render.write(tmp_path / "within.ipynb", small_notebook(burn, budget=60))
    render.write(tmp_path / "over.ipynb", small_notebook(burn, budget=1))
    command = [sys.executable, "-m", "pytest", "--nbmake", "-p", "no:cacheprovider", str(tmp_path)]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120).stdout
    assert "1 failed, 1 passed" in said and re.search(r"over.ipynb took \d+ s of CPU, and its budget is 1 s", said), (
        said
    )
