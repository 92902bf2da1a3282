"""What a training will need is counted on models without numbers; here against models with them, and by hand."""

from dataclasses import replace

import pytest

from minicmdm.cli import main
from minicmdm.config import as_system, preset
from minicmdm.models.dit import CausalDiT
from minicmdm.models.vae import MACVAE
from minicmdm.training.estimate import estimate


def by_stage(plan, accumulate=1):
    return {line.stage: line for line in estimate(plan, accumulate)}


def test_parameters_are_those_of_the_models_and_of_the_papers_table():
    plan = preset("micro")
    found = by_stage(plan)
    for stage, model in (("vae", MACVAE(plan.vae)), ("dit", CausalDiT(plan.dit))):
        assert found[stage].parameters == sum(weight.numel() for weight in model.parameters())
    assert by_stage(preset("M"))["dit"].parameters / 1e6 == pytest.approx(38.7, rel=0.01)  # CMDM Table 10


def test_arithmetic_and_memory_grow_as_they_must():
    plan = preset("micro")
    one = by_stage(plan)
    twice = by_stage(replace(plan, train=replace(plan.train, dit_batch=2 * plan.train.dit_batch)))
    assert 1.9 < twice["dit"].flops / one["dit"].flops < 2.0  # all but the modulation of the levels
    kept = [x["dit"].memory - 20 * x["dit"].parameters for x in (one, twice)]
    assert 1.9 < kept[1] / kept[0] < 2.0
    doubled = by_stage(as_system(plan, "window"))["dit"].flops / by_stage(as_system(plan, "flood"))["dit"].flops
    assert 1.9 < doubled < 2.2  # a clip and its clean copy
    three = by_stage(plan, accumulate=3)  # in turn: three times the work in the same memory
    assert three["vae"].flops == 3 * one["vae"].flops and three["vae"].memory == one["vae"].memory


def test_a_feedforward_layer_by_hand():
    """Twice the feed-forward width adds, forward and backward, 3 * 2 * tokens * (in * more + more * out)."""
    plan = preset("micro")
    deeper = replace(plan, dit=replace(plan.dit, layers=plan.dit.layers + 1))
    dim, tokens, words = plan.dit.dim, plan.train.dit_batch * 49, plan.train.dit_batch * 20
    linear = 2 * (tokens * (4 * dim**2 + 2 * dim**2 + 4 * dim**2) + words * 2 * dim**2 + 64 * 6 * dim**2)
    scores = 2 * 2 * tokens * dim * (49 + 20)
    added = by_stage(deeper)["dit"].flops - by_stage(plan)["dit"].flops
    # The backward pass takes two products for each forward one, but none towards the words, which are given.
    assert added == 3 * (linear + scores) - 2 * words * 2 * dim**2


def test_a_dry_run_says_it_and_makes_nothing(tmp_path, capsys):
    assert main(["train", "--preset", "micro", "--dry-run", "--out", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in said] == ["tmr:", "vae:", "dit:"] and all("GFLOPs a step" in x for x in said)
    assert not (tmp_path / "run").exists()
