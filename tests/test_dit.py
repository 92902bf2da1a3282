"""Causal-DiT: who sees whom, in float64 and with no weight left at zero."""

from dataclasses import replace

import pytest
import torch
from model_helpers import dependencies, lower_triangle, randomise

from minicmdm.config import DiTConfig
from minicmdm.models.dit import CausalDiT, self_attention_mask
from minicmdm.models.text import Words

TINY = DiTConfig(latent_dim=3, text_dim=5, dim=16, layers=2, heads=2, time_dim=8)


def inputs(batch=1, latents=8, words=4, seed=0):
    """z_t, t, words and a word mask that shows everything."""
    g = torch.Generator().manual_seed(seed)
    kwargs = dict(generator=g, dtype=torch.float64)
    z_t, t = torch.randn(batch, latents, 3, **kwargs), torch.rand(batch, latents, **kwargs)
    return z_t, t, torch.randn(batch, words, 16, **kwargs), torch.ones(batch, latents, words, dtype=torch.bool)


@pytest.fixture
def model():
    return randomise(CausalDiT(TINY))


@pytest.mark.parametrize("block_size", [1, 2, 3])
def test_a_latent_sees_its_block_and_the_past_and_nothing_else(block_size):
    model = randomise(CausalDiT(replace(TINY, block_size=block_size)))
    z_t, t, words, mask = inputs()
    expected = lower_triangle(8, block_size)
    assert torch.equal(dependencies(lambda z: model(z, t, words, mask), z_t), expected)
    # ... and the same for the noise level that each latent is told
    by_time = dependencies(lambda t: model(z_t, t.squeeze(-1) * 0.5, words, mask), t.unsqueeze(-1))
    assert torch.equal(by_time, expected)


def test_bidirectional_sees_everything():
    model = randomise(CausalDiT(replace(TINY, attention="bidirectional")))
    z_t, t, words, mask = inputs()
    assert dependencies(lambda z: model(z, t, words, mask), z_t).all()


def test_mask_of_the_paper_and_of_the_release():
    assert torch.equal(self_attention_mask(4, 1, "causal"), torch.ones(4, 4).tril().bool())
    assert self_attention_mask(4, 3, "causal").int().tolist() == [[1, 1, 1, 0]] * 3 + [[1, 1, 1, 1]]


def test_window_is_causal_before_the_boundary_and_open_after():
    committed = torch.tensor([[True, True, False, False], [False] * 4])
    mask = self_attention_mask(4, 3, "window", committed=committed)  # whatever the block size
    assert mask[0].int().tolist() == [[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]]
    assert mask[1].all()
    with pytest.raises(ValueError, match="committed"):
        self_attention_mask(4, 1, "window")


@pytest.mark.parametrize("finished", [0, 3, 8])
def test_a_window_model_takes_clean_latents_for_the_past(finished):
    model = randomise(CausalDiT(replace(TINY, attention="window")))
    z_t, t, words, mask = inputs()
    t = 0.9 * t
    t[:, :finished] = 1.0
    committed = torch.arange(8).expand(1, -1) < finished
    expected = self_attention_mask(8, 1, "window", committed=committed)[0]
    assert torch.equal(dependencies(lambda z: model(z, t, words, mask), z_t), expected)
    assert torch.equal(model(z_t, t, words, mask), model(z_t, t, words, mask, committed=committed))
    everything = torch.zeros_like(committed)  # the control: who is committed can be said, and then it counts
    assert dependencies(lambda z: model(z, t, words, mask, committed=everything), z_t).all()


def test_dropping_the_future_changes_nothing(model):
    z_t, t, words, mask = inputs(latents=70)  # longer than the release's table of 49 positions
    whole, part = model(z_t, t, words, mask), model(z_t[:, :30], t[:, :30], words, mask[:, :30])
    assert torch.allclose(whole[:, :30], part, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("attention", ["causal", "bidirectional", "window"])
def test_padding_of_latents_and_of_words_changes_nothing(attention):
    model = randomise(CausalDiT(replace(TINY, attention=attention)))
    z_t, t, words, mask = inputs(batch=2)
    z_t[0, 5:], words[0, 3:] = 1e3, 1e3  # garbage where sample 0 is padded
    mask[0, :, 3:] = False
    valid = torch.ones(2, 8, dtype=torch.bool)
    valid[0, 5:] = False
    both = model(z_t, t, words, mask, valid)
    alone = model(z_t[:1, :5], t[:1, :5], words[:1, :3], mask[:1, :5, :3])
    assert torch.allclose(both[0, :5], alone[0], rtol=1e-9, atol=1e-12)
    assert torch.allclose(both[1], model(z_t[1:], t[1:], words[1:], mask[1:])[0], rtol=1e-9, atol=1e-12)
    assert both.isfinite().all()


def test_a_word_moves_only_the_latents_that_see_it_and_those_after(model):
    z_t, t, words, mask = inputs()
    mask[:, :5, 2] = False  # word 2 is said from latent 5 on
    moved = words.clone()
    moved[:, 2] += 10
    change = (model(z_t, t, moved, mask) - model(z_t, t, words, mask)).abs().amax(dim=(0, 2))
    assert (change[:5] == 0).all() and (change[5:] > 1e-6).all()


def test_a_latent_that_sees_no_word_is_finite_and_trains(model):
    z_t, t, words, mask = inputs()
    mask[:, 2] = False
    out = model(z_t, t, words, mask)
    out.square().sum().backward()  # the embedding of words is not in it: `read` does that
    grads = [p.grad for name, p in model.named_parameters() if not name.startswith("embed_words")]
    assert out.isfinite().all() and all(grad.isfinite().all() for grad in grads)
    mask[:] = False
    assert torch.equal(model(z_t, t, words, mask), model(z_t, t, words * 5, mask))


def test_order_matters(model):
    z_t, t, words, mask = inputs()
    z_t[:, 1], t[:, 1] = z_t[:, 0], t[:, 0]
    z_t[:, 2], t[:, 2] = z_t[:, 0] + 1, t[:, 0]
    swapped = z_t[:, [0, 2, 1, 3, 4, 5, 6, 7]]
    assert not torch.allclose(model(z_t, t, words, mask)[:, 7], model(swapped, t, words, mask)[:, 7])


def test_neighbouring_noise_levels_look_different(model):
    """Unscaled, a 256-wide sinusoid of t in [0,1] hardly moves between two of twenty levels."""
    z_t, t, words, mask = inputs()
    one, two = (model(z_t, torch.full_like(t, value), words, mask) for value in (0.50, 0.55))
    assert (one - two).abs().mean() > 0.05 * one.abs().mean()


def test_a_new_model_predicts_zero():
    out = CausalDiT(TINY)(*[x.float() if x.is_floating_point() else x for x in inputs()])
    assert torch.equal(out, torch.zeros_like(out))


@pytest.mark.parametrize("name, index, shape", [("t", 1, (1, 7)), ("words", 2, (1, 4, 6)), ("word_mask", 3, (1, 4))])
def test_shape_errors_name_the_argument(model, name, index, shape):
    arguments = list(inputs())
    arguments[index] = torch.zeros(shape)
    with pytest.raises(ValueError, match=name):
        model(*arguments)


def test_unknown_attention_and_block_size():
    with pytest.raises(ValueError, match="causal, bidirectional"):
        CausalDiT(replace(TINY, attention="sideways"))
    with pytest.raises(ValueError, match="v, x0, eps"):
        CausalDiT(replace(TINY, target="score"))
    with pytest.raises(ValueError, match="block_size"):
        CausalDiT(replace(TINY, block_size=0))


def test_words_read_their_own_sentence_only():
    """No word of another sentence, nor padding, changes how a sentence is read; its own words all do."""
    model = randomise(CausalDiT(replace(TINY, text_layers=2, text_dim=8)))
    torch.manual_seed(0)
    words = Words(torch.randn(2, 5, 8, dtype=torch.float64), torch.tensor([[True] * 3 + [False] * 2, [True] * 5]))

    def read(x):  # (1,10,8): the words of both, one after the other
        return model.read(Words(x.view(2, 5, 8), words.mask)).embeddings.view(1, 10, 16)

    seen = dependencies(read, words.embeddings.view(1, 10, 8))
    expected = torch.zeros(10, 10, dtype=torch.bool)
    expected[:3, :3] = expected[5:, 5:] = True
    assert torch.equal(seen[:3], expected[:3]) and torch.equal(seen[5:], expected[5:])  # rows 3 and 4 are padding
    alone = model.read(Words(words.embeddings[:1, :3], words.mask[:1, :3]))
    torch.testing.assert_close(model.read(words).embeddings[:1, :3], alone.embeddings, rtol=1e-9, atol=1e-9)
    swapped = Words(words.embeddings[1:, [1, 0, 2, 3, 4]], words.mask[1:])  # order matters: not a bag of words
    assert not torch.allclose(model.read(swapped).embeddings[:, 2:], model.read(words).embeddings[1:, 2:])
