"""Presets: the paper's sizes, JSON and back, and errors that name what is wrong."""

import json
from dataclasses import replace

import pytest
import torch

from minicmdm.config import PRESETS, Preset, TextConfig, preset
from minicmdm.models.dit import CausalDiT
from minicmdm.models.vae import MACVAE


@pytest.mark.parametrize("name, millions", [("S", 19.8), ("M", 38.7), ("L", 129.1), ("XL", 304.6)])
def test_denoiser_sizes_of_table_10(name, millions):
    with torch.device("meta"):  # shapes without memory
        model = CausalDiT(preset(name).dit)
    assert abs(sum(p.numel() for p in model.parameters()) / 1e6 / millions - 1) < 0.01


def test_the_shipped_toy_is_small():
    toy = preset("toy")
    with torch.device("meta"):
        count = sum(p.numel() for part in (MACVAE(toy.vae), CausalDiT(toy.dit)) for p in part.parameters())
    # The text encoder at its largest vocabulary: embeddings, then per layer 4 projections and a 2x feed-forward.
    text = toy.text
    count += (text.vocab_size + text.max_words) * text.dim + text.layers * (8 * text.dim**2 + 11 * text.dim)
    assert 2 * count < 8e6  # shipped in float16; with the teacher and the judges all assets stay under 20 MB


@pytest.mark.parametrize("name", PRESETS)
def test_json_round_trip(name):
    there = json.dumps(preset(name).to_dict())
    assert Preset.from_dict(json.loads(there)) == preset(name)


def test_unknown_preset_lists_the_known_ones():
    with pytest.raises(ValueError, match="toy, micro, S, M, L, XL"):
        preset("tiny")


def test_a_foreign_dictionary_is_refused_by_the_key_that_is_wrong():
    data = preset("toy").to_dict()
    data["dit"]["heds"] = data["dit"].pop("heads")
    with pytest.raises(ValueError, match=r"'dit'.*heads.*heds"):
        Preset.from_dict(data)
    with pytest.raises(ValueError, match="vae"):
        Preset.from_dict({**preset("toy").to_dict(), "vae": 3})


def test_what_an_older_version_did_not_know_is_as_it_was_then():
    data = preset("toy").to_dict()
    for part, key in (("train", "accumulate"), ("train", "word_drop"), ("dit", "path")):
        del data[part][key]
    assert Preset.from_dict(data) == preset("toy")
    with pytest.raises(ValueError, match="'preset': missing keys .'vae'"):
        Preset.from_dict({key: value for key, value in preset("toy").to_dict().items() if key != "vae"})


def test_parts_that_do_not_fit_are_refused():
    toy = preset("toy")
    with pytest.raises(ValueError, match="channels per latent"):
        replace(toy, vae=replace(toy.vae, latent_dim=8))
    with pytest.raises(ValueError, match="words of width"):
        replace(toy, text=TextConfig())
