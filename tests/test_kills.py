"""Training that is killed, again and again and at any moment, ends in the weights of a run that nobody disturbed."""

import os
import random
import signal
import time

import pytest
import torch
from torch import nn

from minicmdm.training.loop import LoopConfig, fit

KILLS = 20
CONFIG = LoopConfig(steps=120, lr=0.01, warmup=10, muon=0.01, log_every=7, validate_every=20, save_every=3)


def models():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        blocks = nn.ModuleList(nn.Sequential(nn.Linear(8, 8), nn.Dropout(0.2), nn.GELU()) for _ in range(2))
        return nn.ModuleDict({"net": nn.ModuleDict({"blocks": blocks, "out": nn.Linear(8, 1)})})


def loss(models, _, generator):
    x = torch.randn(16, 8, generator=generator)
    h = x
    for block in models["net"]["blocks"]:
        h = h + block(h)  # dropout draws from the global generator, which the loop keys by the step
    return (models["net"]["out"](h)[:, 0] - x.sin().sum(1)).square().mean(), {}


def train(folder):
    return fit(
        "kills", models(), loss, lambda ema: {"norm": 1.0}, CONFIG, folder, identity={}, resume=True, progress=False
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork, to kill a process in the middle of a step")
def test_twenty_kills_change_nothing(tmp_path):
    torch.set_num_threads(1)
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    unbroken = train(tmp_path / "whole")
    whole, pace, dice, killed = unbroken.ema.state_dict(), unbroken.seconds, random.Random(0), 0
    for _ in range(10 * KILLS):
        child = os.fork()
        if child == 0:  # no test of pytest's goes on in here, whatever happens
            try:
                train(tmp_path / "killed")
            finally:
                os._exit(0)
        time.sleep(dice.uniform(0.0, 0.2) * pace)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        killed += os.WIFSIGNALED(status)
        if killed == KILLS or not os.WIFSIGNALED(status):
            break
    left = [path.name for path in (tmp_path / "killed").iterdir() if path.suffix == ".safetensors"]
    assert [name for name in left if not name.startswith(".")] in (["state_kills.safetensors"], [])
    resumed = train(tmp_path / "killed").ema.state_dict()
    assert killed >= 5, "the run ended before it could be killed often enough"
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)
