"""The house rules that a machine can check: short files, no pickles, no network, one licence, few dependencies."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "minicmdm").rglob("*.py"))


def test_no_file_is_longer_than_an_essay():
    long = {str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text("utf-8").splitlines())) > 300}
    assert len(SOURCES) > 25 and not long


def test_nothing_is_unpickled():
    for path in SOURCES:
        text = path.read_text("utf-8")
        assert not re.search(r"\bimport pickle\b|(?<!safetensors\.)torch\.load\(|allow_pickle=True|joblib", text), path
        for call in re.findall(r"np\.load\([^\n]*", text):
            assert "allow_pickle=False" in call, (path, call)


def test_scripts_that_run_in_a_browser_ask_nobody():
    scripts = sorted((ROOT / "minicmdm").rglob("*.js"))
    assert scripts and not any("http" in p.read_text("utf-8") for p in scripts)


def test_every_public_function_has_a_docstring():
    import ast

    bare = []
    for path in SOURCES:
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                if ast.get_docstring(node) is None:
                    bare.append(f"{path.name}:{node.name}")
    assert not bare


@pytest.mark.parametrize("name", ["torch", "transformers", "matplotlib", "scipy", "IPython"])
def test_import_and_help_load_nothing_heavy(name):
    code = "import sys, minicmdm.cli; minicmdm.cli.main(['--help']); print(sys.argv[1] in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code, name], capture_output=True, text=True)
    assert run.returncode == 0 and run.stdout.splitlines()[-1] == "False", run.stderr


def test_the_flat_face_names_what_it_promises():
    import minicmdm

    for name in ("MotionPipeline", "joints_to_features", "features_to_joints", "schedule_matrix", "read_motion"):
        assert callable(getattr(minicmdm, name))
    with pytest.raises(AttributeError):
        minicmdm.nothing_of_that_name  # noqa: B018
