"""Diffusion forcing: independent levels, the right target, and padding that cannot leak in."""

import math

import pytest
import torch

from minicmdm.diffusion.forcing import diffusion_forcing_loss, draw_boundary, draw_staircase, draw_times
from minicmdm.diffusion.path import cosine_alpha_bar, data_to_velocity


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("block_size", [1, 3])
def test_times_are_uniform_equal_in_a_block_and_independent_between_blocks(block_size):
    t = draw_times(4000, 7, block_size, seeded())
    assert t.shape == (4000, 7) and t.min() >= 0 and t.max() < 1
    assert torch.allclose(t.mean(0), torch.tensor(0.5), atol=0.02)
    assert torch.allclose(t.var(0), torch.tensor(1 / 12), atol=0.005)
    together = torch.corrcoef(t.T)
    same_block = (torch.arange(7) // block_size)[:, None] == torch.arange(7) // block_size
    assert (together[same_block] > 0.999).all() and (together[~same_block].abs() < 0.08).all()


def test_a_power_draws_noisy_latents_more_often():
    t = draw_times(4000, 7, 1, seeded(), power=2.0)
    below = torch.tensor([0.04, 0.25, 0.64])
    share = (t.flatten()[:, None] < below).float().mean(0)
    assert torch.allclose(share, below.sqrt(), atol=0.02)  # P(u^2 < x) = sqrt(x)


def test_a_model_that_knows_the_data_has_no_loss_and_a_silent_one_pays_the_target():
    torch.manual_seed(0)
    z = 2 * torch.randn(64, 16, 4, dtype=torch.float64)
    knows = diffusion_forcing_loss(lambda z_t, t, *_: data_to_velocity(z_t, z, t), z, None, None, generator=seeded())
    silent = diffusion_forcing_loss(lambda z_t, *_: torch.zeros_like(z_t), z, None, None, generator=seeded())
    assert knows < 1e-9
    assert math.isclose(silent, 4 + 1, rel_tol=0.1)  # E |z - eps|^2 = Var z + Var eps


def test_padding_cannot_leak_in():
    torch.manual_seed(0)
    z = torch.randn(2, 6, 3)
    valid = torch.ones(2, 6, dtype=torch.bool)
    valid[0, 4:] = False

    def loss(z):
        return diffusion_forcing_loss(lambda z_t, *_: 0.3 * z_t, z, None, None, valid, generator=seeded())

    broken = z.clone().requires_grad_()
    with torch.no_grad():
        broken[0, 4:] = torch.nan
    assert torch.equal(loss(z), loss(broken))

    def per_latent(z_t, *_):  # an error of exactly n at latent n, wherever its target is
        return z_t * 0

    flat = diffusion_forcing_loss(per_latent, torch.zeros(2, 6, 3), None, None, valid, generator=seeded())
    draw_times(2, 6, 1, g := seeded())
    eps = torch.randn(2, 6, 3, generator=g)
    assert torch.allclose(flat, eps[valid].square().mean())  # a mean over valid latents, not over all


def test_the_seed_decides():
    z = torch.randn(2, 6, 3)
    losses = [diffusion_forcing_loss(lambda z_t, *_: z_t, z, None, None, generator=seeded(s)) for s in (1, 1, 2)]
    assert losses[0] == losses[1] != losses[2]


def test_the_model_receives_text_and_mask_as_they_are():
    seen = []

    def model(z_t, t, words, word_mask, valid, clock):
        seen.append((t.shape, words, word_mask, valid, clock))
        return z_t

    diffusion_forcing_loss(model, torch.randn(2, 6, 3), "words", "mask", None, block_size=3, clock="clock")
    assert seen == [(torch.Size([2, 6]), "words", "mask", None, "clock")]


# --- the paper's objective ------------------------------------------------------------------------------------------


def test_the_papers_objective_is_noise_at_integer_levels_on_its_own_path():
    """CMDM Eqs 9 and 10, Alg. 1: with z known, x says what the noise was."""
    z, times = 2 * torch.randn(64, 40, 4, dtype=torch.float64, generator=seeded()), []

    def knows(x, t, *_):
        times.append(t)
        alpha_bar = cosine_alpha_bar(1 - t).unsqueeze(-1)
        return (x - alpha_bar.sqrt() * z) / (1 - alpha_bar).sqrt().clamp_min(1e-9)

    losses = [
        diffusion_forcing_loss(m, z, None, None, block_size=2, generator=seeded(), path="ddpm")
        for m in (knows, lambda x, *_: torch.zeros_like(x), lambda x, *_: x)
    ]
    level = 1000 * (1 - times[0])
    assert torch.allclose(level, level.round(), atol=1e-9) and level.min() >= 0 and level.max() <= 1000
    assert torch.equal(level[:, ::2], level[:, 1::2]) and len(level.unique()) > 50
    assert losses[0] < 0.02  # only level 0 holds nothing of its noise
    assert math.isclose(losses[1], 1, rel_tol=0.05)  # Var eps
    assert losses[2] > 1  # x is not the noise


def test_every_level_is_drawn_as_often(monkeypatch):
    t = torch.arange(4004, dtype=torch.float64).reshape(1, -1) / 4004  # a fine and even comb
    monkeypatch.setattr("minicmdm.diffusion.forcing.draw_times", lambda *_: t)
    seen = []
    model = lambda x, t, *_: seen.append(t) or x  # noqa: E731
    diffusion_forcing_loss(model, torch.zeros(1, 4004, 1, dtype=torch.float64), None, None, path="ddpm")
    counts = torch.bincount((1000 * (1 - seen[0][0])).round().long())
    assert len(counts) == 1001 and counts.min() >= 3 and counts.max() <= 5  # rounding may move one to a neighbour


def test_an_unknown_path_is_refused():
    with pytest.raises(ValueError, match="'flow' or 'ddpm'"):
        diffusion_forcing_loss(lambda z_t, *_: z_t, torch.zeros(1, 2, 3), None, None, path="vp")


# --- window attention -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["flow", "ddpm"])
def test_the_committed_are_given_clean_and_are_not_asked_for(path):
    z, seen = torch.randn(16, 6, 3, generator=seeded()), []

    def model(x, t, words, mask, valid, clock, committed):
        seen.append((x, t, committed))
        return torch.where(committed[..., None], torch.nan, 0 * x)

    committed, visible = draw_boundary(torch.ones(16, 6, dtype=torch.bool), 2, seeded())
    loss = diffusion_forcing_loss(model, z, None, None, visible, 2, generator=seeded(1), path=path, committed=committed)
    x, t, told = seen[0]
    assert committed.any() and not visible.all() and told is committed and loss.isfinite() and loss > 0.5
    assert torch.equal(x[committed], z[committed]) and (t[committed] == 1).all()
    assert (t[~committed] < 1).float().mean() > 0.9


def test_the_boundary_of_training_is_drawn_everywhere():
    valid = torch.arange(10) < torch.tensor([10, 7, 1])[:, None].repeat(1, 1).repeat_interleave(2000, 0)
    committed, visible = draw_boundary(valid, 3, seeded())
    past, shown = committed.sum(1), visible.sum(1)
    place = torch.arange(10)
    assert torch.equal(committed, place < past[:, None]) and torch.equal(visible, place < shown[:, None])
    assert (past < shown).all() and (visible <= valid).all()  # somebody is in flight, and no padding is
    assert set(past[:2000].tolist()) == {0, 3, 6, 9} and set(shown[:2000].tolist()) == {3, 6, 9, 10}
    assert set(shown[2000:4000].tolist()) == {3, 6, 7} and set(shown[4000:].tolist()) == {1}
    assert abs((past[:2000] == 0).float().mean() - (1 / 4 + 3 / 4 / 4)) < 0.05
    again = draw_boundary(valid, 3, seeded())
    assert torch.equal(again[0], committed) and torch.equal(again[1], visible)


def test_the_staircase_is_what_fss_presents():
    """Finished, then times falling by one height, then nothing; and a sampler's rows are among what is drawn."""
    valid = torch.arange(12) < torch.tensor([12, 5])[:, None].repeat_interleave(3000, 0)
    t, committed, visible = draw_staircase(valid, 2, seeded())
    past, shown = committed.sum(1), visible.sum(1)
    place = torch.arange(12)
    assert torch.equal(committed, place < past[:, None]) and torch.equal(visible, place < shown[:, None])
    assert (past < shown).all() and (visible <= valid).all()
    assert (t[committed] == 1).all() and (t[~committed] < 1).all() and t.min() >= 0
    assert torch.equal(t[:, 0::2][:3000], t[:, 1::2][:3000])  # one level a block
    steps = t[:3000, 0::2].diff(dim=1)  # (B,5)
    moving = ~committed[:3000, 0:-2:2] & visible[:3000, 2::2]  # both neighbours are in flight
    heights = -steps[moving]
    assert (heights > 0.03).all() and (heights < 1).all() and heights.min() < 0.07
    some = moving.sum(1) >= 2  # every step of one sample is as high as the others, up to the rounding of times
    spread = torch.where(moving, steps, torch.nan)[some]
    assert (spread.nan_to_num(-9).amax(1) - spread.nan_to_num(9).amin(1) < 2.01 / 64).all()
    begun = t[:3000][past[:3000] == 0][:, 0]  # with no past the first one may be anywhere on its way
    assert abs(begun.mean() - 0.5) < 0.05
    front = t[:3000].gather(1, past[:3000, None].clamp(max=11))[past[:3000] > 0]
    assert front.mean() > 0.75  # with a past it starts from where the last step of its neighbour left it
