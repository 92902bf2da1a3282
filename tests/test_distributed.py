"""Several processes train as one does: the same losses, the same weights, one set of files."""

import csv
import json
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch
from conftest import make_fake_data
from torch import nn

from minicmdm.training import stages
from minicmdm.training.checkpoints import load_tensors
from minicmdm.training.distributed import Team
from minicmdm.training.loop import LoopConfig, LoopResult, fit

SCRIPT = """
import sys
from dataclasses import replace
import torch
from minicmdm.config import preset
from minicmdm.training import stages
torch.set_num_threads(1)
plan = preset("micro")
steps = {f"{name}_steps": 10 for name in stages.RUN} | {f"{name}_batch": 4 for name in stages.RUN}
stages.FAST.update(steps)
plan = replace(plan, train=replace(plan.train, bfloat16=False))
for stage in ("tmr", "vae", "dit"):
    stages.train(plan, sys.argv[1], stage, fast=True, accumulate=2, progress=False)
"""


def losses(folder):
    """The losses of every stage, as they were logged."""
    found = {}
    for path in sorted(folder.glob("losses_*.csv")):
        with open(path, encoding="utf-8", newline="") as file:
            found[path.name] = [float(row["loss"]) for row in csv.DictReader(file) if row["loss"]]
    return found


def test_two_processes_train_as_one(tmp_path):
    pytest.importorskip("accelerate", reason="needs the extra [scale]")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    launch = ["-m", "accelerate.commands.launch", "--cpu", "--num_processes", "2", "--num_machines", "1"]
    launch += ["--mixed_precision", "no", "--dynamo_backend", "no", "--main_process_port", "0"]
    for how, out in (([], "one"), (launch, "two")):
        done = subprocess.run(
            [sys.executable, *how, str(script), str(tmp_path / out)], capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
    one, two = losses(tmp_path / "one"), losses(tmp_path / "two")
    assert set(one) == set(two) == {"losses_tmr.csv", "losses_vae.csv", "losses_dit.csv"}
    for name, values in one.items():
        assert len(values) > 3
        assert two[name] == pytest.approx(values, rel=1e-5), name
    for name in ("tmr", "vae", "dit"):
        weights = [load_tensors(tmp_path / out / f"{name}.safetensors")[0] for out in ("one", "two")]
        for key, value in weights[0].items():
            torch.testing.assert_close(weights[1][key], value, rtol=1e-4, atol=1e-5)


def line(parts, batch, tmp_path):
    """A straight line fitted to numbers that a generator draws, `parts` batches a step."""
    torch.manual_seed(0)
    models = nn.ModuleDict({"net": nn.Linear(3, 1)})
    seen = []

    def loss(models, _, generator):
        x = torch.randn(batch, 3, generator=generator)
        seen.append(x)
        return (models["net"](x)[:, 0] - x.sum(1)).square().mean(), {}

    config = LoopConfig(steps=3, lr=0.1, warmup=1, accumulate=parts)
    result = fit("line", models, loss, lambda ema: {}, config, tmp_path, identity={}, progress=False)
    return models["net"].weight, seen, result


def test_micro_batches_are_different_and_their_gradients_are_the_mean(tmp_path):
    weight, seen, _ = line(4, 5, tmp_path)
    assert len(seen) == 12 and len({tuple(x.flatten().tolist()) for x in seen}) == 12
    torch.manual_seed(0)
    net = nn.Linear(3, 1)
    optimizer = torch.optim.AdamW(net.parameters(), lr=0.1, betas=(0.9, 0.99), weight_decay=0.0)
    from minicmdm.training.loop import learning_rate

    for step in range(3):
        x = torch.cat(seen[4 * step : 4 * step + 4])  # one batch of all of them has the same gradient
        optimizer.zero_grad()
        (net(x)[:, 0] - x.sum(1)).square().mean().backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.param_groups[0]["lr"] = learning_rate(LoopConfig(steps=3, lr=0.1, warmup=1), step)
        optimizer.step()
    torch.testing.assert_close(weight, net.weight)


def test_batches_drawn_ahead_by_threads_come_in_order_and_are_the_same():
    def work(turn):
        time.sleep(0.02 * (turn % 3 == 0))  # some take longer than those after them
        return turn, torch.randn(2, generator=torch.Generator().manual_seed(turn)).tolist()

    one, many = (list(Team(workers=workers).ahead(work, range(20))) for workers in (0, 3))
    assert one == many and [turn for turn, _ in many] == list(range(20))
    with pytest.raises(ValueError, match="workers must not be negative"):
        Team(workers=-1)


def test_a_thread_that_fails_is_heard():
    def work(turn):
        raise ZeroDivisionError(turn)

    with pytest.raises(ZeroDivisionError):
        list(Team(workers=2).ahead(work, range(3)))


def test_workers_change_no_number(tmp_path):
    weights = []
    for workers in (0, 2):
        torch.manual_seed(0)
        models = nn.ModuleDict({"net": nn.Linear(3, 1)})

        def loss(models, x, generator):
            noise = torch.randn(len(x), generator=generator)  # goes on where the draw left off
            return (models["net"](x)[:, 0] - x.sum(1) + noise).square().mean(), {}

        config, folder = LoopConfig(steps=9, lr=0.1, warmup=1, accumulate=2), tmp_path / str(workers)
        folder.mkdir()
        how = {"identity": {}, "progress": False, "draw": lambda generator: torch.randn(4, 3, generator=generator)}
        fit("line", models, loss, lambda ema: {}, config, folder, team=Team(workers=workers), **how)
        weights.append(models["net"].weight.detach().clone())
    assert torch.equal(*weights)


def test_what_cannot_be_shared_is_refused():
    team = Team()
    team.size, team.rank = 3, 1
    assert list(team.share(6)) == [1, 4]
    with pytest.raises(ValueError, match="4 micro-batches .* 3 processes: give --accumulate 3"):
        team.share(4)
    with pytest.raises(ValueError, match="no device 'abacus'"):
        Team("abacus")


def test_a_run_of_several_processes_without_accelerate_says_so(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setitem(sys.modules, "accelerate", None)
    assert Team().size == 1  # a loop outside `train` is nobody's team
    with pytest.raises(ValueError, match="need accelerate"):
        Team(together=True)


def test_training_asks_for_a_device_before_it_touches_anything(tmp_path):
    with pytest.raises(ValueError, match="no device"):
        stages.train("micro", tmp_path / "run", fast=True, device="abacus")
    assert not (tmp_path / "run").exists()


def test_bf16_is_a_flag_and_the_card_tells(tiny_preset, tmp_path, monkeypatch):
    told = []
    plan = replace(tiny_preset, train=replace(tiny_preset.train, bfloat16=False))
    monkeypatch.setattr(stages, "_datasets", lambda *_: (make_fake_data(6), make_fake_data(4, seed=1)))
    monkeypatch.setitem(
        stages.RUN, "tmr", lambda plan, *_, **__: told.append(plan.train.bfloat16) or LoopResult({}, {}, 0.0)
    )
    for bf16 in (False, True):
        out = stages.train(plan, tmp_path / str(bf16), "tmr", bf16=bf16, progress=False)
        assert json.loads((out / "card.json").read_text())["preset"]["train"]["bfloat16"] == told[-1] == bf16
