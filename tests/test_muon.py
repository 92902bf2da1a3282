"""Muon makes torch's own step, several matrices at once; and its step is orthogonal."""

import pytest
import torch
from torch import nn

from minicmdm.config import DiTConfig
from minicmdm.models.dit import CausalDiT
from minicmdm.training.loop import LoopConfig, make_optimizers
from minicmdm.training.muon import Muon, inner_matrices, orthogonal

SHAPES = [(8, 8), (8, 8), (24, 8), (8, 16)]


def matrices():
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="torch has Muon since 2.9")
def test_several_steps_are_torchs_own():
    ours, theirs = matrices(), matrices()
    own = Muon(ours, lr=0.02)
    other = torch.optim.Muon(theirs, lr=0.02, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    for step in range(4):
        generator = torch.Generator().manual_seed(step)
        for a, b in zip(ours, theirs):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        own.step()
        other.step()
    for a, b, start in zip(ours, theirs, matrices()):
        assert (a - start).abs().max() > 0.01
        torch.testing.assert_close(a - start, b - start, rtol=0.03, atol=2e-3)  # both round to bfloat16 on the way


def test_every_singular_value_ends_near_one():
    steep = torch.diag(torch.tensor([100.0, 10.0, 1.0, 0.5]))
    turn = torch.linalg.qr(torch.randn(4, 4, generator=torch.Generator().manual_seed(0)))[0]
    for x in (turn @ steep @ turn.T, (turn @ steep)[:, :3], (turn @ steep)[:3]):
        values = torch.linalg.svdvals(orthogonal(x[None])[0].float())
        assert values.max() < 1.3 and values.min() > 0.2, values


def test_only_the_blocks_matrices_are_muons_and_every_weight_has_one_optimiser():
    dit = CausalDiT(DiTConfig(latent_dim=4, text_dim=6, dim=16, layers=2, heads=2, time_dim=8, text_layers=1))
    inner = {id(weight) for weight in inner_matrices(dit)}
    names = {name for name, weight in dit.named_parameters() if id(weight) in inner}
    assert {"blocks.0.self_attention.query.weight", "blocks.1.modulation.weight"} <= names
    assert "word_blocks.0.attention.key.weight" in names
    assert not names & {"embed_latent.weight", "out.weight", "embed_time.0.weight", "blocks.0.norm2.weight"}
    for rate, kinds in ((0.0, {"adamw"}), (1e-3, {"adamw", "muon"})):
        optimizers = make_optimizers(dit, LoopConfig(steps=1, lr=1e-3, muon=rate))
        assert set(optimizers) == kinds
        stepped = [
            id(w) for optimizer in optimizers.values() for group in optimizer.param_groups for w in group["params"]
        ]
        assert sorted(stepped) == sorted(id(weight) for weight in dit.parameters())


def test_what_is_no_matrix_is_refused():
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        Muon([nn.Parameter(torch.zeros(3))], lr=0.1)
