"""The command line: what is printed where, and that every bad request ends in one line, exit code 2 and no change."""

import io
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from minicmdm import cli, commands
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints, retarget


@pytest.fixture(scope="module")
def joints():
    """A motion of the toy world."""
    return features_to_joints(make_clip("val", 0).features).astype(np.float32)


@pytest.fixture
def here(tmp_path, monkeypatch, tiny_run, joints):
    """A working folder with good, broken and foreign files in it."""
    monkeypatch.chdir(tmp_path)
    np.save("good.npy", joints)
    np.save("flat.npy", joints.reshape(len(joints), -1))
    np.save("features.npy", np.zeros((40, 263), np.float32))
    np.save("empty.npy", joints[:0])
    np.save("words.npy", np.full((4, 22, 3), "walk"))
    np.save("complex.npy", joints.astype(np.complex64))
    np.save("objects.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save("nan.npy", np.where(np.arange(len(joints))[:, None, None] == 7, np.nan, joints))
    np.save("millimetres.npy", joints * 1e6)
    np.savez("many.npz", a=joints)
    (tmp_path / "cut.npy").write_bytes((tmp_path / "good.npy").read_bytes()[:1000])
    (tmp_path / "cut_header.npy").write_bytes((tmp_path / "good.npy").read_bytes()[:20])
    (tmp_path / "nothing.npy").write_bytes(b"")
    (tmp_path / "text.npy").write_text("hello")
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999, 22, 3), }".ljust(117) + b"\n"
    (tmp_path / "boast.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    (tmp_path / "folder.npy").mkdir()
    (tmp_path / "mine.npy").write_text("mine")
    (tmp_path / "mine.json").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    shutil.copytree(tiny_run, "cut_checkpoint")
    weights = tmp_path / "cut_checkpoint" / "dit.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "card.json").write_text('{"model_type": "bert"}')
    return tmp_path


def snapshot(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


GENERATE = ["generate", "a person walks", "--out", "new.npy"]
BAD = {
    "nothing": ([], "COMMAND"),
    "unknown command": (["dance"], "dance"),
    "unknown flag": ([*GENERATE, "--colour", "red"], "--colour"),
    "abbreviated flag": ([*GENERATE, "--fr", "40"], "--fr"),
    "no prompt": (["generate"], "PROMPT"),
    "empty prompt": (["generate", "", "--out", "new.npy"], "prompt is empty"),
    "blank prompt": (["generate", "  ", "--out", "new.npy"], "prompt is empty"),
    "long prompt": (["generate", "walk " * 300, "--out", "new.npy"], "too long"),
    "0 frames": ([*GENERATE, "--frames", "0"], "from 4"),
    "3 frames": ([*GENERATE, "--frames", "3"], "from 4"),
    "100000 frames": ([*GENERATE, "--frames", "100000"], "196"),
    "word frames": ([*GENERATE, "--frames", "many"], "--frames"),
    "nan guidance": ([*GENERATE, "--guidance", "nan"], "guidance"),
    "inf guidance": ([*GENERATE, "--guidance", "inf"], "guidance"),
    "unknown schedule": ([*GENERATE, "--schedule", "ddim"], "fss"),
    "uncertainty": ([*GENERATE, "--uncertainty", "21"], "at most"),
    "negative seed": ([*GENERATE, "--seed", "-1"], "seed"),
    "no steps": ([*GENERATE, "--steps", "0"], "steps"),
    "missing checkpoint": ([*GENERATE, "--checkpoint", "nowhere"], "nowhere"),
    "empty checkpoint": ([*GENERATE, "--checkpoint", ""], "checkpoint"),
    "file as checkpoint": ([*GENERATE, "--checkpoint", "good.npy"], "good.npy"),
    "foreign checkpoint": ([*GENERATE, "--checkpoint", "foreign"], "not the card of a minicmdm checkpoint"),
    "cut checkpoint": ([*GENERATE, "--checkpoint", "cut_checkpoint"], "dit.safetensors"),
    "existing output": (["generate", "walks", "--out", "mine.npy"], "--force"),
    "folder as output": (["generate", "walks", "--out", "full"], "is a folder"),
    "folder named .npy": (["generate", "walks", "--out", "folder.npy", "--force"], "is a folder"),
    "unknown ending": (["generate", "walks", "--out", "new.mp3"], ".html"),
    "no ending": (["generate", "walks", "--out", "new"], ".html"),
    "empty output": (["generate", "walks", "--out", ""], "empty"),
    "missing parent": (["generate", "walks", "--out", "no/new.npy"], "does not exist"),
    "file as parent": (["generate", "walks", "--out", "mine.npy/new.npy"], "does not exist"),
    "demo into a file": (["demo", "--out", "mine.npy"], "is a file"),
    "demo without parent": (["demo", "--out", "no/demo"], "does not exist"),
    "inspect nothing": (["inspect", "absent.npy"], "absent.npy"),
    "inspect folder": (["inspect", "full"], "is a folder"),
    "inspect flat": (["inspect", "flat.npy"], "(T,22,3)"),
    "inspect features": (["inspect", "features.npy"], "features_to_joints"),
    "inspect no frames": (["inspect", "empty.npy"], "(T,22,3)"),
    "inspect words": (["inspect", "words.npy"], "real numbers"),
    "inspect complex": (["inspect", "complex.npy"], "real numbers"),
    "inspect objects": (["inspect", "objects.npy"], "not a whole .npy file"),
    "inspect nan": (["inspect", "nan.npy"], "frame 7"),
    "inspect millimetres": (["inspect", "millimetres.npy"], "metres"),
    "inspect npz": (["inspect", "many.npz"], ".npz"),
    "inspect cut": (["inspect", "cut.npy"], "not a whole .npy file"),
    "inspect cut header": (["inspect", "cut_header.npy"], "not a whole .npy file"),
    "inspect empty file": (["inspect", "nothing.npy"], "not a whole .npy file"),
    "inspect text": (["inspect", "text.npy"], "not a whole .npy file"),
    "inspect boast": (["inspect", "boast.npy"], "not a whole .npy file"),
    "schedule L > K": (["schedule", "--steps", "4", "--uncertainty", "5"], "at most"),
    "schedule L < 0": (["schedule", "--uncertainty", "-1"], "uncertainty"),
    "schedule no latents": (["schedule", "--latents", "0"], "num_latents"),
    "schedule no steps": (["schedule", "--steps", "0"], "num_steps"),
    "schedule no block": (["schedule", "--block", "0"], "block"),
    "schedule kind": (["schedule", "--kind", "zigzag"], "fss"),
    "schedule huge": (["schedule", "--latents", "1000000000", "--steps", "1000000000"], "too much"),
    "data nothing": (["data"], "ACTION"),
    "data parent": (["data", "make", "--out", "no/data"], "does not exist"),
    "data full": (["data", "make", "--out", "full"], "not empty"),
    "data foreign": (["data", "make", "--out", "full", "--force"], "something else"),
    "data file": (["data", "make", "--out", "mine.npy", "--force"], "is a file"),
    "train preset": (["train", "--preset", "huge", "--out", "run"], "toy"),
    "train stage": (["train", "--out", "run", "--stage", "gan"], "vae, dit, all"),
    "train file": (["train", "--out", "mine.npy", "--fast"], "is a file"),
    "train over": (["train", "--out", "cut_checkpoint", "--fast"], "--resume"),
    "train dit first": (["train", "--out", "run", "--stage", "dit", "--fast"], "vae.safetensors"),
    "train data": (["train", "--out", "run", "--data", "full"], "train.txt"),
    "train seed": (["train", "--out", "run", "--seed", "-3"], "--seed"),
    "train threads": (["train", "--out", "run", "--threads", "0"], "--threads"),
    "train system": (["train", "--out", "run", "--system", "mdm"], "cmdm, flood, mardm, cdamd, window"),
    "compare its own way": (["evaluate", "--compare", "--steps", "5"], "leave out --steps"),
    "compare guidance": (["evaluate", "--compare", "--guidance", "2"], "leave out --guidance"),
    "evaluate limit": (["evaluate", "--quick", "--limit", "0"], "--limit"),
    "evaluate too few": (["evaluate", "--limit", "31"], "at least 32"),
    "evaluate protocol": (["evaluate", "--protocol", "t2v"], "t2m or recon"),
    "evaluate judge": (["evaluate", "--evaluator", "tmr"], "t2m_essential"),
    "evaluate never": (["evaluate", "--repeats", "0"], "repeats"),
    "evaluate quickly and not": (["evaluate", "--quick", "--protocol", "t2m"], "leave out --protocol"),
    "evaluate a quick table": (["evaluate", "--quick", "--table"], "leave out --table"),
    "evaluate in two forms": (["evaluate", "--table", "--json"], "not allowed with"),
    "evaluate over": (["evaluate", "--out", "mine.json"], "--force"),
    "evaluate nowhere": (["evaluate", "--out", "no/result.json"], "does not exist"),
    "evaluate ending": (["evaluate", "--out", "result.csv"], ".json, .txt"),
    "evaluate nobody": (["evaluate", "--checkpoint", "nowhere"], "nowhere"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_requests_end_in_one_line(name, here, tiny_run, capsys):
    arguments, message = BAD[name]
    if arguments[:1] == ["generate"] and "--checkpoint" not in arguments:
        arguments = [*arguments, "--checkpoint", str(tiny_run)]
    before = snapshot(here)
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line not in ("minicmdm: reading the data",)]
    assert out == "" and len(lines) == 1 and lines[0].startswith("minicmdm: "), err
    assert message in lines[0] and "Traceback" not in err
    assert snapshot(here) == before


def test_refusals_come_before_the_work(here, monkeypatch):
    monkeypatch.setattr("minicmdm.pipeline.MotionPipeline.from_pretrained", lambda name: pytest.fail("loaded"))
    for arguments in (["--out", "mine.npy"], ["--out", "no/x.npy"], ["--out", "x.mp3"]):
        assert cli.main(["generate", "walks", *arguments]) == 2


@pytest.mark.skipif(
    os.name == "nt" or os.geteuid() == 0 and not os.path.isdir("/proc"), reason="needs a folder that refuses"
)
def test_unwritable_folder(tiny_run, capsys):
    assert cli.main(["generate", "walks", "--out", "/proc/x.npy", "--checkpoint", str(tiny_run)]) == 2
    assert "takes no files" in capsys.readouterr().err


def test_generate_writes_joints_and_says_so_on_stderr(here, tiny_run, capsys):
    command = ["generate", "a person walks", "--frames", "30", "--steps", "4", "--checkpoint", str(tiny_run)]
    assert cli.main([*command, "--out", "one.npy"]) == 0
    assert cli.main([*command, "--out", "two.npy", "--seed", "0", "--schedule", "fss", "--uncertainty", "2"]) == 0
    assert cli.main([*command, "--out", "mine.npy", "--force", "--seed", "1"]) == 0
    out, err = capsys.readouterr()
    assert out == "" and "one.npy" in err
    one, two, other = (np.load(here / name) for name in ("one.npy", "two.npy", "mine.npy"))
    assert one.shape == (30, 22, 3) and one.dtype == np.float32
    assert np.array_equal(one, two) and not np.array_equal(one, other)
    assert cli.main([*command, "--out", "rigid.npy", "--rigid"]) == 0
    np.testing.assert_allclose(np.load(here / "rigid.npy"), retarget(one, scale_path=False), atol=1e-5)


def test_inspect_reads_what_the_oracle_sees(here, capsys):
    assert cli.main(["inspect", "good.npy", "--json"]) == 0
    out, err = capsys.readouterr()
    segments = json.loads(out)["segments"]
    assert err == "" and segments
    keys = ["action", "side", "direction", "speed", "count", "overlay", "start", "end"]
    assert all(list(segment) == keys for segment in segments)
    assert cli.main(["inspect", "good.npy"]) == 0
    text = capsys.readouterr().out
    assert len(text.splitlines()) == len(segments) and segments[0]["action"] in text


def test_schedule_contract(capsys):
    assert cli.main("schedule --latents 8 --steps 6 --uncertainty 2 --block 3 --kind fss --json".split()) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer) == {"matrix", "calls", "latents_in_flight"}
    assert np.shape(answer["matrix"]) == (6 + 2 * 2 + 1, 8)
    assert answer["calls"] == 10 and answer["latents_in_flight"] == 8
    assert answer["matrix"][0] == [6] * 8 and answer["matrix"][-1] == [0] * 8
    assert cli.main("schedule --latents 3 --steps 4".split()) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split("|")[1].split() == ["3", "4", "4"] and lines[-1].startswith("8 calls, at most 2")


def test_evaluate_prints_one_json_object(monkeypatch, tiny_run, capsys):
    quick = pytest.importorskip("minicmdm.evaluation.quick")
    monkeypatch.setattr(quick, "evaluate_quick", lambda pipe, progress, limit: {"oracle_accuracy": 0.5, "limit": limit})
    assert cli.main(["evaluate", "--quick", "--json", "--limit", "3", "--checkpoint", str(tiny_run)]) == 0
    assert json.loads(capsys.readouterr().out) == {"oracle_accuracy": 0.5, "limit": 3}


def test_data_make_replaces_only_data(here, monkeypatch, capsys):
    from minicmdm.data import dataset, folders

    monkeypatch.setattr(dataset, "SPLITS", {"train": 3, "val": 2, "test": 2})
    assert cli.main(["data", "make", "--out", "world"]) == 0
    assert len(folders.load_dataset(here / "world", "train")) == 3
    assert cli.main(["data", "make", "--out", "world"]) == 2
    assert cli.main(["data", "make", "--out", "world", "--force"]) == 0
    assert capsys.readouterr().out == ""


def test_interrupt_is_130(monkeypatch, capsys):
    def interrupt(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "schedule", interrupt)
    assert cli.main(["schedule"]) == 130
    assert capsys.readouterr().err == "minicmdm: interrupted\n"


def test_errors_are_printable_anywhere(monkeypatch):
    class Terminal(io.StringIO):
        encoding = "ascii"

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    assert cli.main(["inspect", "gehängt\udcff.npy"]) == 2
    assert terminal.getvalue().isascii() and terminal.getvalue().count("\n") == 1


def test_help_does_not_load_torch():
    script = "import sys, minicmdm.cli as c; c.main(['generate', '--help']); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "False" and "--uncertainty" in done.stdout


def test_a_reader_that_leaves_is_no_error():
    command = f'"{sys.executable}" -m minicmdm schedule --latents 90 --steps 90'
    process = subprocess.Popen(command, shell=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    process.wait()


@pytest.mark.skipif(os.name == "nt", reason="POSIX locales")
def test_any_locale(here):
    """LC_ALL=C with every helper off: a path that ASCII cannot spell is opened, or named with escapes."""
    os.rename("good.npy", "ö.npy")
    bare = {**os.environ, "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "minicmdm", "inspect", "--json"]
    done = subprocess.run([*command, "ö.npy"], capture_output=True, env=bare, timeout=60)
    assert done.returncode == 0 and json.loads(done.stdout)["segments"], done.stderr
    done = subprocess.run([*command, "ü.npy"], capture_output=True, env=bare, timeout=60)
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1 and done.stderr.isascii()


def test_a_sentence_is_utf8_whatever_the_locale_made_of_it():
    assert commands._as_typed("a persön") == "a persön"
    escaped = "a persön".encode().decode("ascii", "surrogateescape")  # what LC_ALL=C hands to Python
    assert commands._as_typed(escaped) == "a persön"
    assert commands._as_typed("pers\udcf6n") == "pers\udcf6n"  # a Latin-1 byte: left for the pipeline to refuse


def test_demo_writes_a_player_and_a_gif_of_each_scene(tmp_path, capsys):
    assert cli.main(["demo", "--out", str(tmp_path / "demo")]) == 0
    files = sorted(file.suffix for file in (tmp_path / "demo").iterdir())
    assert files == [".gif"] * 3 + [".html"] * 3
    said = capsys.readouterr().out
    assert said.count("the oracle sees: ") == 3 and said.count(str(tmp_path)) == 6
    assert cli.main(["demo", "--out", str(tmp_path / "demo")]) == 2  # and overwrites nothing unasked
