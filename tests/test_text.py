"""Words: the vocabulary, the mask, the null sentence, saving, and what must be refused."""

import json
import socket
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from minicmdm.config import TextConfig
from minicmdm.models.text import TextEncoder

TINY = TextConfig(dim=16, layers=1, heads=2, vocab_size=120, max_words=12, dropout=0.1, frozen=False)
CAPTIONS = ["a person walks forward", "a person waves with the left hand", "someone jumps twice, then sits down"]


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("the text encoder opened a socket")

    monkeypatch.setattr(socket, "socket", refuse)


@pytest.fixture
def encoder():
    torch.manual_seed(0)
    return TextEncoder.from_captions(CAPTIONS, TINY).eval()


def test_shapes_and_mask(encoder):
    words = encoder.encode(["a person", "a person walks forward", ""])
    assert words.embeddings.shape == (3, 6, 16) and words.mask.dtype == torch.bool
    assert words.mask.sum(1).tolist() == [4, 6, 2]  # [CLS] and [SEP] are words too
    assert words.mask[1].all() and not words.mask[0, 4:].any()


def test_padding_does_not_change_a_sentence(encoder):
    alone = encoder.encode(["a person"]).embeddings[0]
    beside = encoder.encode(["a person", CAPTIONS[2]]).embeddings[0, : len(alone)]
    assert torch.allclose(alone, beside, atol=1e-5)


def test_case_and_unknown_words(encoder):
    assert torch.equal(encoder.encode(["A Person WALKS"]).embeddings, encoder.encode(["a person walks"]).embeddings)
    assert not torch.allclose(
        encoder.encode(["person walks forward"]).embeddings, encoder.encode(["forward walks person"]).embeddings
    )
    assert encoder.encode(["漢"]).embeddings.isfinite().all()


def test_long_sentences_are_cut_to_max_words(encoder):
    assert encoder.encode(["walks " * 50]).mask.shape == (1, 12)


def test_the_vocabulary_is_the_captions_words_in_an_order_that_never_changes(encoder):
    again = TextEncoder.from_captions(CAPTIONS[::-1], TINY)
    assert again.tokenizer.get_vocab() == encoder.tokenizer.get_vocab()
    assert encoder.config["vocab_size"] == encoder.tokenizer.get_vocab_size() <= TINY.vocab_size
    pieces = encoder.tokenizer.encode("A person jumps, waver").tokens
    assert pieces[:5] == ["[CLS]", "a", "person", "jumps", ","]  # known words stay whole
    assert pieces[5:] == ["w", "##a", "##v", "##e", "##r", "[SEP]"]  # others are spelt


def test_a_small_vocabulary_keeps_the_commonest_words():
    few = replace(TINY, vocab_size=5 + 2 * 37 + 2)  # letters, digits and the comma, then two words
    kept = TextEncoder.from_captions(CAPTIONS, few).tokenizer.get_vocab()
    assert {word for word in kept if len(word) > 1 and word[0] not in "[#"} == {
        "person",
        "down",
    }  # twice; then the first of the ties
    with pytest.raises(ValueError, match="vocab_size 20"):
        TextEncoder.from_captions(CAPTIONS, replace(TINY, vocab_size=20))


def test_save_and_load_are_bit_equal(encoder, tmp_path):
    encoder.save(tmp_path)
    loaded = TextEncoder.load(tmp_path, TINY).eval()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "model.safetensors", "tokenizer.json"]
    for one, two in zip(encoder.encode(CAPTIONS), loaded.encode(CAPTIONS)):
        assert torch.equal(one, two)


def test_a_hub_checkpoint_loads_through_the_same_door(encoder, tmp_path):
    """The layout of distilbert-base-uncased: a prefix, a language-model head, and arguments we do not use."""
    encoder.save(tmp_path)
    weights = {f"distilbert.{name}": w for name, w in load_file(tmp_path / "model.safetensors").items()}
    save_file({**weights, "vocab_projector.bias": torch.zeros(3)}, tmp_path / "model.safetensors")
    config = json.loads((tmp_path / "config.json").read_text())
    config.pop("minicmdm")
    config |= {"architectures": ["DistilBertForMaskedLM"], "tie_weights_": True, "seq_classif_dropout": 0.2}
    (tmp_path / "config.json").write_text(json.dumps(config))
    frozen = TextEncoder.load(tmp_path, replace(TINY, frozen=True))
    assert torch.equal(frozen.encode(CAPTIONS).embeddings, encoder.encode(CAPTIONS).embeddings)


def test_a_frozen_encoder_never_drops_words_and_makes_no_gradient():
    frozen = TextEncoder.from_captions(CAPTIONS, replace(TINY, frozen=True, dropout=0.5))
    outer = torch.nn.ModuleList([frozen]).train()  # what a training loop does to everything
    assert not outer[0].bert.training
    assert torch.equal(frozen.encode(CAPTIONS).embeddings, frozen.encode(CAPTIONS).embeddings)
    assert not frozen.encode(CAPTIONS).embeddings.requires_grad
    assert not any(p.requires_grad for p in frozen.parameters())


def test_a_trainable_encoder_learns(encoder):
    encoder.train().encode(CAPTIONS).embeddings.square().sum().backward()
    assert encoder.bert.training
    assert encoder.bert.embeddings.word_embeddings.weight.grad.abs().sum() > 0


@pytest.mark.parametrize("bad", ["a person walks", [3], ["ok", None]])
def test_only_lists_of_sentences(encoder, bad):
    with pytest.raises(ValueError, match="list of sentences"):
        encoder.encode(bad)


def test_no_captions_no_vocabulary():
    with pytest.raises(ValueError, match="empty"):
        TextEncoder.from_captions([], TINY)


def test_an_absent_folder_says_how_to_get_one(tmp_path):
    with pytest.raises(FileNotFoundError, match="hf download distilbert-base-uncased"):
        TextEncoder.load(tmp_path / "nothing", TextConfig())


def test_damaged_or_foreign_folders_are_refused(encoder, tmp_path):
    encoder.save(tmp_path)
    with pytest.raises(ValueError, match="width 768"):
        TextEncoder.load(tmp_path, TextConfig())
    whole = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="cannot be read"):
        TextEncoder.load(tmp_path, TINY)
    (tmp_path / "model.safetensors").write_bytes(whole)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "n_layers": 2}))
    with pytest.raises(ValueError, match="does not fit"):
        TextEncoder.load(tmp_path, TINY)
