"""The exercises' frame (three answers, and no fourth) and, for each exercise, mutants that its check must reject."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from minicmdm.exercises import EXERCISES, Exercise, budget, check, expect, frame, hint, must, n00, solution


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# One file of wrong answers for each notebook: exercise id -> functions that its check must reject.
MUTANTS = {}
for path in sorted((Path(__file__).parent / "mutants").glob("m*.py")):
    MUTANTS |= load(path).MUTANTS


@pytest.mark.parametrize("id", EXERCISES)
def test_reference_is_right_and_says_so_in_one_line(id, capsys):
    check(id, EXERCISES[id].reference)
    assert capsys.readouterr().out == f"Exercise {id}: right.\n"


@pytest.mark.parametrize(("id", "mutant"), [(id, mutant) for id in EXERCISES for mutant in MUTANTS[id]])
def test_mutants_are_rejected_with_the_call_and_the_property(id, mutant):
    with pytest.raises(AssertionError, match=r"(?s)\w>?\(.+\) (gives|raises) .+\w"):
        check(id, mutant)


@pytest.mark.parametrize("id", EXERCISES)
def test_each_exercise_has_mutants_a_hint_and_an_id_of_its_notebook(id):
    assert len(MUTANTS[id]) >= 2 and len(EXERCISES[id].hint) > 20
    assert id == EXERCISES[id].id and id[2] == "." and id.replace(".", "").isdigit()


def raises_not_implemented(*_):
    raise NotImplementedError


@pytest.mark.parametrize("id", EXERCISES)
@pytest.mark.parametrize(
    "stub", [None, ..., lambda *_: ..., lambda *_: (1, (..., 2)), lambda *_: {"a": [...]}, raises_not_implemented]
)
def test_an_untouched_stub_gets_the_hint_and_no_error(id, stub, capsys):
    check(id, stub)
    said = capsys.readouterr().out
    assert "not attempted" in said and EXERCISES[id].hint in said and "right" not in said.split("Hint")[0]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda frames, width: None, r"\(4, 12\) gives None, is a `return` missing\?"),
        (lambda frames, width: 7, r"gives 7, which cannot be read"),
        (lambda frames, width: (1, 2, 3), r"gives \(1, 2, 3\), which cannot be read"),
        (lambda frames: (1, 2), r"raises TypeError"),
        (lambda frames, width: 1 / 0, r"raises ZeroDivisionError"),
        (42, r"expects a function, and int came"),
    ],
)
def test_wrong_kinds_of_answer_are_wrong_and_not_a_crash(answer, message):
    with pytest.raises(AssertionError, match=message):
        check("00.1", answer)


def test_the_failing_case_is_the_smallest():
    wrong_from_nine = lambda n, c: n00.motion_shapes(n if n < 9 else n + 4, c)  # noqa: E731
    with pytest.raises(AssertionError, match=r"^<lambda>\(9, 8\) gives"):
        check("00.1", wrong_from_nine)


def test_the_shapes_are_those_of_the_real_pipeline(tiny_pipe, monkeypatch):
    seen = {}
    decode = tiny_pipe.decode
    monkeypatch.setattr(tiny_pipe, "decode", lambda z: seen.setdefault("features", decode(seen.setdefault("z", z))))
    for frames in (4, 13, 20):
        seen.clear()
        motion = tiny_pipe("a person walks", frames, num_steps=1, uncertainty=0)
        latents, features, joints = n00.motion_shapes(frames, tiny_pipe.preset.dit.latent_dim)
        assert seen["z"].shape == (1, *latents) and seen["features"].shape == (1, *features)
        assert motion.joints.shape == joints


def test_checking_leaves_the_readers_random_numbers_alone():
    torch.manual_seed(5)
    wanted = torch.rand(1)
    torch.manual_seed(5)
    check("00.2", n00.first_frame_moved)
    assert torch.equal(torch.rand(1), wanted)


def test_hint_and_solution(capsys, monkeypatch):
    monkeypatch.delenv("MINICMDM_SOLUTIONS", raising=False)
    hint("00.1")
    assert capsys.readouterr().out.strip() == EXERCISES["00.1"].hint
    solution("00.1")
    assert "def motion_shapes(" in capsys.readouterr().out
    monkeypatch.setenv("MINICMDM_SOLUTIONS", "0")
    solution("00.1")
    said = capsys.readouterr().out
    assert "hidden" in said and "def " not in said


@pytest.mark.parametrize("ask", [hint, solution, lambda id: check(id, None)])
def test_an_unknown_exercise_is_refused_with_those_there_are(ask):
    with pytest.raises(ValueError, match=r"'99\.9'.*00\.1, 00\.2"):
        ask("99.9")


def test_an_answer_that_the_proof_never_calls_is_still_reported(monkeypatch):
    broken = Exercise("00.9", "a hint", len, lambda answer: must(False, "Law."))
    monkeypatch.setitem(EXERCISES, "00.9", broken)
    with pytest.raises(AssertionError, match=r"never called\. Law\."):
        check("00.9", len)


def test_large_arrays_are_named_by_their_shape():
    assert frame._brief(np.zeros((5, 7))) == "<ndarray of shape (5, 7)>"
    assert frame._brief(torch.ones(2)) == "tensor([1., 1.])"


def test_fast_mode_shortens_training_and_skips_expectations(monkeypatch, capsys):
    monkeypatch.setenv("MINICMDM_FAST", "1")
    assert budget(1500, fast=20) == 20
    expect(False, "the model waves")
    assert capsys.readouterr().out == "skipped in fast mode: the model waves\n"
    monkeypatch.setenv("MINICMDM_FAST", "0")
    assert budget(1500, fast=20) == 1500
    expect(True, "the model waves")
    assert capsys.readouterr().out == "as expected: the model waves\n"
    with pytest.raises(AssertionError, match="not found: the model waves"):
        expect(False, "the model waves")
