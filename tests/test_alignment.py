"""The alignment losses against slow loops and by hand, and the weight against gradients known in closed form."""

import math

import pytest
import torch
from torch import nn

from minicmdm.alignment import adaptive_weight, alignment_loss, group_mean, marginal_cosine, marginal_distance_matrix


def cosine(a, b):
    return sum(x * y for x, y in zip(a, b)) / math.sqrt(sum(x * x for x in a) * sum(y * y for y in b))


def slow_cosine_loss(z, f, margin):
    gaps = [max(0.0, 1 - margin - cosine(z[b][i], f[b][i])) for b in range(len(z)) for i in range(len(z[b]))]
    return sum(gaps) / len(gaps)


def slow_matrix_loss(z, f, margin):
    gaps = []
    for b in range(len(z)):  # one sequence at a time
        for i in range(len(z[b])):
            for j in range(len(z[b])):
                gaps.append(max(0.0, abs(cosine(z[b][i], z[b][j]) - cosine(f[b][i], f[b][j])) - margin))
    return sum(gaps) / len(gaps)


@pytest.fixture
def latents():
    generator = torch.Generator().manual_seed(0)
    z, projected, f = (torch.randn(3, 5, width, generator=generator, dtype=torch.float64) for width in (4, 6, 6))
    return z, projected, f


@pytest.mark.parametrize("margin", [0.0, 0.25, 0.5])
def test_both_losses_are_their_slow_loops(latents, margin):
    z, projected, f = latents
    fast = marginal_cosine(projected, f, margin)
    assert math.isclose(fast, slow_cosine_loss(projected.tolist(), f.tolist(), margin), rel_tol=1e-9)
    fast = marginal_distance_matrix(z, f, margin)
    assert math.isclose(fast, slow_matrix_loss(z.tolist(), f.tolist(), margin), rel_tol=1e-9)


def test_the_margins_are_the_papers(latents):
    z, projected, f = latents
    assert marginal_cosine(projected, f) == marginal_cosine(projected, f, 0.5)
    assert marginal_distance_matrix(z, f) == marginal_distance_matrix(z, f, 0.25)


def test_by_hand():
    east, north = [1.0, 0.0], [0.0, 2.0]
    z, f = torch.tensor([[east, north, east]]), torch.tensor([[east, east, [-3.0, 0.0]]])
    # cosines 1, 0, -1: gaps to 1 - 0.5 of 0, 0.5 and 1.5
    assert math.isclose(marginal_cosine(z, f), 2.0 / 3, rel_tol=1e-6)
    # z's pairs: 01 0, 02 1, 12 0. f's: 1, -1, -1. Gaps 1, 2, 1, each twice among nine pairs, less 0.25.
    assert math.isclose(marginal_distance_matrix(z, f), 2 * (0.75 + 1.75 + 0.75) / 9, rel_tol=1e-6)


def test_lengths_do_not_matter_and_a_turn_does_not_matter_to_the_matrix(latents):
    z, projected, f = latents
    assert torch.allclose(marginal_cosine(7 * projected, 0.1 * f), marginal_cosine(projected, f))
    turned = torch.linalg.qr(z[0, :4])[0]
    assert torch.allclose(marginal_distance_matrix(7 * z @ turned, f), marginal_distance_matrix(z, f))
    assert marginal_distance_matrix(f @ torch.eye(6, dtype=f.dtype)[[5, 4, 3, 2, 1, 0]], f, 0.0) < 1e-12


def test_sequences_do_not_meet(latents):
    z, _, f = latents
    apart = torch.stack([marginal_distance_matrix(z[b : b + 1], f[b : b + 1]) for b in range(3)])
    assert torch.allclose(marginal_distance_matrix(z, f), apart.mean())


def test_what_is_alike_enough_is_left_alone():
    f = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    z = torch.tensor([[[1.0, 1.0], [-0.1, 1.0]]], requires_grad=True)  # cosines 0.71 and 0.995, to each other 0.63
    loss = marginal_cosine(z, f)
    loss.backward()
    assert loss == 0 and z.grad.abs().max() == 0
    marginal_cosine(z, f, margin=0.2).backward()
    assert z.grad[0, 0].abs().max() > 0 and z.grad[0, 1].abs().max() == 0


def test_equation_3_and_its_two_readings(latents):
    z, projected, f = latents
    cosines = marginal_cosine(projected, f)
    assert torch.equal(alignment_loss(z, projected, f), cosines + marginal_distance_matrix(z, f))
    released = alignment_loss(z, projected, f, matrix_of="projected")
    assert torch.equal(released, cosines + marginal_distance_matrix(projected, f))
    assert not torch.allclose(released, alignment_loss(z, projected, f), rtol=1e-3)


def test_the_teacher_is_not_taught(latents):
    z, projected, f = (x.clone().requires_grad_() for x in latents)
    alignment_loss(z, projected, f).backward()
    assert f.grad is None and z.grad.abs().sum() > 0 and projected.grad.abs().sum() > 0


def test_bfloat16_counts_in_float32(latents):
    z, projected, f = (x.bfloat16() for x in latents)
    exact = alignment_loss(z.double(), projected.double(), f.double())
    with torch.autocast("cpu", torch.bfloat16):
        loss = alignment_loss(z, projected, f)
    assert loss.dtype == torch.float32 and math.isclose(loss, exact, rel_tol=1e-5)


def test_descending_it_aligns():
    """A free latent and a free map, 16 against 64 wide: both terms fall to their margins."""
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(2, 8, 64, generator=generator).cumsum(1)
    z, project = torch.randn(2, 8, 16, generator=generator).requires_grad_(), nn.Linear(16, 64, bias=False)
    optimiser = torch.optim.Adam([z, *project.parameters()], lr=0.03)
    losses = []
    for _ in range(150):
        losses.append(alignment_loss(z, project(z), f))
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert losses[0] > 0.5 and losses[-1] < 0.01


def test_the_weight_is_the_ratio_of_two_known_gradients():
    weight = nn.Parameter(torch.tensor([3.0, 4.0]))
    rec, align = weight.square().sum(), 0.5 * weight.sum()  # gradients 2 w, of norm 10, and (0.5, 0.5)
    ratio = adaptive_weight(rec, align, weight)
    assert math.isclose(ratio, 10 / math.sqrt(0.5), rel_tol=1e-6) and not ratio.requires_grad
    assert adaptive_weight(rec, align, weight, clamp=3.0) == 3.0
    assert weight.grad is None  # it measures and leaves nothing behind
    (rec + ratio * align).backward()  # and both graphs are still there
    assert torch.allclose(weight.grad, 2 * weight.detach() + ratio * 0.5)


def test_with_the_weight_both_pull_equally_whatever_their_scales():
    weight = nn.Parameter(torch.tensor([1.0, -2.0]))
    for scale in (1e-2, 1.0, 1e2):
        rec, align = scale * weight.square().sum(), weight.pow(3).sum()
        pulled = torch.autograd.grad(adaptive_weight(rec, align, weight) * align, weight)[0]
        assert math.isclose(pulled.norm(), scale * 2 * math.sqrt(5), rel_tol=1e-5)


def test_the_weight_of_what_pulls_at_nothing_is_finite():
    weight = nn.Parameter(torch.tensor([1.0]))
    assert math.isclose(adaptive_weight(0.01 * weight.sum(), 0.0 * weight.sum(), weight), 100.0, rel_tol=1e-5)
    assert adaptive_weight(5.0 * weight.sum(), 0.0 * weight.sum(), weight) == 1e4  # 5 / 1e-4, clamped
    assert adaptive_weight(0.0 * weight.sum(), weight.sum(), weight) == 0.0


def test_group_mean_by_hand():
    f = torch.arange(8.0).reshape(1, 8, 1)
    assert group_mean(f).tolist() == [[[1.5], [5.5]]]
    assert group_mean(f, group=8).tolist() == [[[3.5]]]
    assert group_mean(torch.randn(2, 12, 5)).shape == (2, 3, 5)


def test_errors_teach(latents):
    z, projected, f = latents
    for wrong in (torch.zeros(1, 6, 3), torch.zeros(1, 0, 3), torch.zeros(8, 3)):
        with pytest.raises(ValueError, match="multiple of 4 frames"):
            group_mean(wrong)
    with pytest.raises(ValueError, match="project z first"):
        marginal_cosine(z, f)
    with pytest.raises(ValueError, match="agree"):
        marginal_distance_matrix(z[:, :4], f)
    with pytest.raises(ValueError, match="'latent' or 'projected', got 'both'"):
        alignment_loss(z, projected, f, matrix_of="both")
