"""A packed twin computes what the model computes, shares its weights, and leaves it as it was."""

import pytest
import torch
from torch import nn

from minicmdm.config import DiTConfig
from minicmdm.evaluation.bench import random_model
from minicmdm.models import packed as module
from minicmdm.models.packed import PackedLinear, can_pack, packed

TINY = DiTConfig(latent_dim=4, text_dim=6, dim=16, layers=2, heads=2, time_dim=8, block_size=3)
needs_packing = pytest.mark.skipif(not can_pack(torch.zeros(1)), reason="this torch cannot keep oneDNN's layout")


@needs_packing
@torch.no_grad()
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.bfloat16, 2e-2)])
@pytest.mark.parametrize("rows", [1, 6, 44])
@pytest.mark.parametrize("bias", [True, False])
def test_a_packed_layer_is_the_layer(dtype, tolerance, rows, bias):
    if not can_pack(torch.zeros(1, dtype=dtype)):
        pytest.skip(f"no oneDNN products in {dtype} here")
    torch.manual_seed(0)
    linear = nn.Linear(24, 40, bias=bias).to(dtype)
    for shape in ((rows, 24), (2, rows, 24), (3, 1, rows, 24)):  # as many rows as it was packed for, and others
        x = torch.randn(shape).to(dtype)
        truth, y = linear(x), PackedLinear(linear, rows)(x)
        assert y.shape == truth.shape and y.dtype == dtype
        torch.testing.assert_close(y, truth, rtol=tolerance, atol=tolerance)


@needs_packing
@torch.no_grad()
def test_the_twin_is_packed_under_its_blocks_and_shares_all_else():
    dit = random_model(TINY)
    before = {name: value.clone() for name, value in dit.state_dict().items()}
    twin = packed(dit, 6, smallest=1)
    kinds = [type(layer) for layer in twin.blocks.modules()]
    assert PackedLinear in kinds and nn.Linear not in kinds
    assert not any(isinstance(layer, PackedLinear) for layer in [*dit.modules(), *packed(dit, 6).modules()])
    assert twin.out.weight is dit.out.weight and twin.embed_words.weight is dit.embed_words.weight
    assert all(torch.equal(before[name], value) for name, value in dit.state_dict().items())
    z, t, words = torch.randn(2, 5, 4), torch.rand(2, 5), torch.randn(2, 3, 16)
    seen = torch.ones(2, 5, 3, dtype=torch.bool)
    truth, y = dit(z, t, words, seen), twin(z, t, words, seen)
    assert truth.abs().max() > 0.1
    torch.testing.assert_close(y, truth, rtol=1e-4, atol=1e-4)


def test_where_nothing_can_be_packed_the_model_itself_comes_back(monkeypatch):
    dit = random_model(TINY)
    assert packed(dit.double(), 6) is dit  # oneDNN has no float64
    monkeypatch.setattr(module, "can_pack", lambda weight: False)
    dit = dit.float()
    assert packed(dit, 6) is dit
