"""Random hands: whatever a file holds and whatever is typed, the answer is a result, or one error that teaches.

Files are valid ones with bytes or words of theirs changed; commands are made of the options that the parser knows.
"""

import contextlib
import io
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_bvh import GOOD

from minicmdm import cli
from minicmdm.data import bvh, folders, imports
from minicmdm.evaluation.evaluators import load_bench
from minicmdm.live import timeline
from minicmdm.models.text import TextEncoder
from minicmdm.motion import load_joints
from minicmdm.pipeline import ASSETS
from minicmdm.training.checkpoints import load_tensors, read_card, read_preset, save_tensors

LABEL = {"start_t": 0.5, "end_t": 2.0, "raw_label": "walk", "proc_label": "walk"}
SEGMENT = {"action": "walk", "side": "left", "direction": None, "speed": "slow", "count": 2, "overlay": None}


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def tensors(folder):
    save_tensors(folder / "a", {"w": torch.ones(2, 3), "b": torch.zeros(2)}, {"words": ["a"]})
    return (folder / "a").read_bytes()


def a_card():
    told = json.loads((ASSETS / "toy" / "card.json").read_text("utf-8"))
    return json.dumps({**told, "files": {}})


def told_of(card):
    """The preset of a card alone in its folder."""
    return read_preset(read_card(card.parent), card.parent)


def good_features(x):
    return x.dtype == np.float32 and x.shape[1:] == (263,) and np.isfinite(x).all()


def good_captions(found):
    whole, stretches = found
    said = [*whole, *(text for some in stretches.values() for text in some)]
    return said and all(text.strip() for text in said) and all(0 <= a < b <= 64 for a, b in stretches)


def good_map(places):
    return all(isinstance(where, str) or len(where) == 3 for where in places.values())


# What a reader reads, how, and what must hold of whatever it returns.
READERS = {
    "1.npy": (lambda _: npy(np.zeros((64, 263), np.float32)), folders.read_features, good_features),
    "joints.npy": (lambda _: npy(np.zeros((4, 22, 3))), load_joints, lambda x: np.isfinite(x).all()),
    "1.txt": (
        lambda _: "he walks.#he/PRON walk/VERB#0.0#0.0\nhe turns#x#0.5#2.0\n",
        lambda path: folders.read_captions(path, 64),
        good_captions,
    ),
    "train.txt": (
        lambda _: "000001\nM000001\na b\n",
        lambda path: folders.split_names(path.parent, "train"),
        lambda names: all((Path("x") / name).parent == Path("x") for name in names),
    ),
    "programs.jsonl": (
        lambda _: json.dumps({"name": "1", "asked": [SEGMENT], "realised": [SEGMENT], "labels": [[0, 40, "walks"]]}),
        lambda path: folders.clip_records(path.parent, "train"),
        lambda records: isinstance(records, dict),
    ),
    "train.json": (
        lambda _: json.dumps({"1": {"frame_ann": {"labels": [LABEL]}, "name": "1"}}),
        folders.babel_labels,
        lambda found: all(a < b for rows in found.values() for a, b, _ in rows),
    ),
    "a.bvh": (lambda _: GOOD, bvh.read_bvh, lambda x: np.isfinite(x.frames).all() and len(x.frames) == 2),
    "map.json": (lambda _: json.dumps({"head": "Head", "neck": ["a", "b", 0.5]}), imports.load_map, good_map),
    "captions.csv": (
        lambda _: 'name,caption\nwalk,"he, she"\nrun.bvh,they run\n',
        imports.read_csv,
        lambda found: all(text for some in found.values() for text in some),
    ),
    "dit.safetensors": (tensors, load_tensors, lambda x: isinstance(x[0], dict)),
    "card.json": (lambda _: a_card(), told_of, lambda preset: preset.dit.dim),
    "plan.tsv": (
        lambda _: "4\ta person walks\n0.5\tthen jumps\n",
        lambda path: list(timeline(path.read_bytes().splitlines(keepends=True))),
        lambda lines: all(frames >= 1 and prompt for frames, prompt in lines),
    ),
}
WORDS = ["nan", "inf", "-1", "0", "1e999", "9" * 30, "null", "[]", "{}", '""', "[" * 9999, "#", "\t", "\n", "..", "\0"]
EDITS = st.lists(
    st.tuples(
        st.integers(0, 10**6),
        st.integers(0, 8) | st.none(),  # so many bytes go, or one whole word
        st.binary(max_size=4) | st.sampled_from([word.encode() for word in WORDS]),
    ),
    min_size=1,
    max_size=3,
)


def edited(raw, edits):
    for where, gone, new in edits:
        words = list(re.finditer(rb"[\w.+-]+|\"[^\"]*\"", raw)) if gone is None else []
        start, end = words[where % len(words)].span() if words else (where % (len(raw) + 1),) * 2
        raw = raw[:start] + new + raw[end + (gone or 0) :]
    return raw


def sample(name, folder):
    made = READERS[name][0](folder)
    return made if isinstance(made, bytes) else made.encode()


@pytest.mark.parametrize("name", READERS)
def test_a_changed_file_is_read_or_refused(name, tmp_path_factory):
    folder = tmp_path_factory.mktemp("read")
    raw, (_, read, good) = sample(name, folder), READERS[name]
    path = folder / name
    path.write_bytes(raw)
    assert good(read(path))  # as it is, it is a valid file

    @settings(derandomize=True, deadline=None, max_examples=80, database=None)
    @given(EDITS | st.binary(max_size=64))
    def attempt(edits):
        path.write_bytes(edits if isinstance(edits, bytes) else edited(raw, edits))
        with contextlib.suppress(ValueError, FileNotFoundError):
            assert good(read(path))

    attempt()


@pytest.mark.parametrize("part", ["tokenizer.json", "config.json"])
def test_a_changed_text_encoder_is_read_or_refused(part, tiny_run, tiny_preset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("read") / "text"
    shutil.copytree(tiny_run / "text", folder)
    raw = (folder / part).read_bytes()

    @settings(derandomize=True, deadline=None, max_examples=30, database=None)
    @given(EDITS)
    def attempt(edits):
        (folder / part).write_bytes(edited(raw, edits))
        with contextlib.suppress(ValueError, FileNotFoundError):
            encoder = TextEncoder.load(folder, tiny_preset.text)
            assert encoder.cfg == tiny_preset.text and not encoder.training
            assert all(torch.isfinite(weight).all() for weight in encoder.state_dict().values())

    attempt()


def test_changed_judges_are_read_or_refused(tiny_run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("read") / "evaluator"
    shutil.copytree(tiny_run / "evaluator", folder)
    raw = (folder / "card.json").read_bytes()

    @settings(derandomize=True, deadline=None, max_examples=30, database=None)
    @given(EDITS)
    def attempt(edits):
        (folder / "card.json").write_bytes(edited(raw, edits))
        with contextlib.suppress(ValueError, FileNotFoundError):
            for name, judge in load_bench(folder).items():
                assert (folder / f"{name}.safetensors").is_file() and not judge.training

    attempt()


# --- what is typed ---------------------------------------------------------------------------------------------------

VALUES = ["", " ", "x", "0", "1", "3", "-1", "2.5", "nan", "-inf", "9" * 40, "w\udcff", "fss", "full", "micro", "toy"]
VALUES += ["t2m", "recon", "all", "vae", "cpu", "set", "set/train.txt", "new.npy", "new.json", "no/new.npy", "bvh"]
VALUES += ["joints.npy", "plan.tsv", ".", "../x", "a person walks"]


def options(parser, path=()):
    """Each command of a parser, as it is typed, with the options it knows: option -> (a value follows, required)."""
    groups = [action.choices for action in parser._actions if isinstance(action.choices, dict)]
    if not groups:
        return {path: {name: (a.nargs != 0, a.required) for a in parser._actions for name in a.option_strings}}
    return {k: v for name, sub in groups[0].items() for k, v in options(sub, (*path, name)).items()}


KNOWN = options(cli._parser())
EVERY = {name: value for some in KNOWN.values() for name, (value, _) in some.items()}


@st.composite
def typed(draw):
    """A command, some of its options with values that may fit, and sometimes a word that is out of place."""
    command = draw(st.sampled_from(sorted(KNOWN)))
    known, anything = KNOWN[command], st.sampled_from(VALUES)
    names = st.sampled_from(sorted(known)) | st.sampled_from(sorted(known)) | st.sampled_from(sorted(EVERY))
    must = [name for name, (_, required) in known.items() if required]
    words = draw(st.lists(anything, max_size=2, unique=True))
    for name in must * draw(st.integers(0, 9).map(bool)) + draw(st.lists(names, max_size=3)):
        words += [name] + [draw(anything)] * EVERY[name]
    return [*command, *words]


@pytest.fixture
def cheap(tmp_path, monkeypatch, tiny_pipe, fake_data):
    """A folder with a file of each kind; what would take long ends where it begins, and all before it is real."""
    from minicmdm import demo, doctor
    from minicmdm.data import dataset
    from minicmdm.evaluation import bench, protocols, quick
    from minicmdm.pipeline import MotionPipeline
    from minicmdm.training import stages

    monkeypatch.chdir(tmp_path)
    real = MotionPipeline.from_pretrained
    monkeypatch.setattr(MotionPipeline, "from_pretrained", lambda name: tiny_pipe if name == "toy" else real(name))
    monkeypatch.setattr(protocols, "evaluate", lambda *_, **__: {"metrics": {}})
    monkeypatch.setattr(quick, "evaluate_quick", lambda *_, **__: {"a": 1.0})
    monkeypatch.setattr(bench, "bench", lambda *_: {"a.b": 1.0})
    monkeypatch.setattr(demo, "perform", lambda *_: [])
    monkeypatch.setattr(doctor, "examine", lambda: ({"a": 1}, []))
    monkeypatch.setattr(dataset, "make_folder", lambda *_, **__: None)
    monkeypatch.setattr(stages, "RUN", {})
    monkeypatch.setattr(stages, "_datasets", lambda *_: (fake_data, fake_data))
    for name in ("set/new_joint_vecs", "set/texts", "bvh"):
        Path(name).mkdir(parents=True)
    Path("set/new_joint_vecs/1.npy").write_bytes(sample("1.npy", tmp_path))
    Path("set/texts/1.txt").write_bytes(sample("1.txt", tmp_path))
    for name in ("train", "val", "test"):
        Path(f"set/{name}.txt").write_text("1\n")
    Path("bvh/a.bvh").write_text(GOOD)
    for name in ("joints.npy", "plan.tsv"):
        Path(name).write_bytes(sample(name, tmp_path))
    yield
    torch.set_num_threads(1)


def test_whatever_is_typed_ends_in_a_result_or_in_one_line(cheap):
    codes = set()

    @settings(derandomize=True, deadline=None, max_examples=150, database=None)
    @given(typed())
    def attempt(argv):
        out, err = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            patch.setattr("sys.stdin", io.StringIO("0.2\ta person walks\n"))
            code = cli.main(argv)
        codes.add(code)
        assert code in (0, 2)
        if code == 2:
            assert err.getvalue().splitlines()[-1].startswith("minicmdm: ") and "Traceback" not in err.getvalue()

    attempt()
    assert codes == {0, 2} and os.listdir("set/texts") == ["1.txt"]
