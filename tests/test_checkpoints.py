"""Checkpoints: what is written is read back, what is broken is said, what is interrupted leaves the old file."""

import json
import pickle
import shutil

import numpy as np
import pytest
import torch

from minicmdm.files import check_output, whole_file
from minicmdm.pipeline import MotionPipeline
from minicmdm.training import checkpoints


def test_tensors_and_note_come_back(tmp_path):
    tensors = {"a": torch.randn(3, 4), "b": torch.arange(5), "view": torch.randn(4, 4).t()}
    checkpoints.save_tensors(tmp_path / "x.safetensors", tensors, {"step": 7, "name": "ü"})
    read, note = checkpoints.load_tensors(tmp_path / "x.safetensors")
    assert note == {"step": 7, "name": "ü"}
    assert all(torch.equal(read[key], value) and read[key].dtype == value.dtype for key, value in tensors.items())


def test_interrupted_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as temporary:
        temporary.write_text("half of the n")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.txt"]


def test_failed_save_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "x.safetensors"
    checkpoints.save_tensors(path, {"a": torch.zeros(2)})
    monkeypatch.setattr("os.fsync", lambda number: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        checkpoints.save_tensors(path, {"a": torch.ones(2)})
    assert checkpoints.load_tensors(path)[0]["a"].sum() == 0
    assert len(list(tmp_path.iterdir())) == 1


def test_whole_checkpoint_loads(tiny_run, tiny_preset):
    checkpoint = checkpoints.load_checkpoint(tiny_run)
    assert checkpoint.preset == tiny_preset
    assert not (checkpoint.vae.training or checkpoint.dit.training or checkpoint.text.training)
    card = checkpoint.card
    assert card["data"]["fingerprint"] == "fake" and card["seed"] == 0
    assert set(card["seconds"]) == {"evaluator", "tmr", "vae", "dit"} and {"mpjpe_mm", "val_loss"} <= set(
        card["metrics"]
    )
    assert not list(tiny_run.glob("**/.minicmdm-*"))


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edit_card(change):
    def damage(folder):
        card = json.loads((folder / "card.json").read_text())
        change(card)
        (folder / "card.json").write_text(json.dumps(card))

    return damage


def other_weights(folder):
    tensors, _ = checkpoints.load_tensors(folder / "vae.safetensors")
    checkpoints.save_tensors(folder / "vae.safetensors", {key: value + 1 for key, value in tensors.items()})


DAMAGES = {
    "no folder": (shutil.rmtree, FileNotFoundError, "no checkpoint folder"),
    "no card": (lambda f: (f / "card.json").unlink(), FileNotFoundError, "no finished checkpoint"),
    "cut card": (lambda f: truncate(f / "card.json"), ValueError, "not a whole JSON file"),
    "foreign card": (lambda f: (f / "card.json").write_text("[1, 2]"), ValueError, "not the card of a minicmdm"),
    "no files in card": (edit_card(lambda c: c.pop("files")), ValueError, "under 'files'"),
    "odd file in card": (edit_card(lambda c: c["files"].update({"../x": "1"})), ValueError, "under 'files'"),
    "unknown preset key": (edit_card(lambda c: c["preset"]["dit"].update(colour=1)), ValueError, "colour"),
    "bad preset value": (edit_card(lambda c: c["preset"]["dit"].update(dim="wide")), ValueError, "cannot be built"),
    "other sizes": (edit_card(lambda c: c["preset"]["vae"].update(width=32)), ValueError, "expected"),
    "VAE only": (edit_card(lambda c: c["files"].pop("dit.safetensors")), ValueError, "stage dit"),
    "missing weights": (lambda f: (f / "dit.safetensors").unlink(), FileNotFoundError, "lacks dit.safetensors"),
    "cut weights": (lambda f: truncate(f / "dit.safetensors"), ValueError, "not a whole safetensors file"),
    "empty weights": (lambda f: (f / "vae.safetensors").write_bytes(b""), ValueError, "not a whole safetensors file"),
    "pickled weights": (
        lambda f: (f / "vae.safetensors").write_bytes(pickle.dumps({"a": 1})),
        ValueError,
        "not a whole safetensors file",
    ),
    "mixed weights": (other_weights, ValueError, "not the file that the card describes"),
    "cut text": (lambda f: truncate(f / "text" / "model.safetensors"), ValueError, "not a whole safetensors file"),
    "cut tokenizer": (lambda f: truncate(f / "text" / "tokenizer.json"), ValueError, "cannot be read"),
    "no tokenizer": (lambda f: (f / "text" / "tokenizer.json").unlink(), FileNotFoundError, "tokenizer.json"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_named(name, tiny_run, tmp_path):
    damage, error, message = DAMAGES[name]
    folder = tmp_path / "copy"
    shutil.copytree(tiny_run, folder)
    damage(folder)
    with pytest.raises(error, match=message):
        checkpoints.load_checkpoint(folder)


def test_nothing_is_unpickled(tiny_run, tmp_path):
    class Bomb:
        def __reduce__(self):
            return open, (str(tmp_path / "exploded"), "w")

    folder = tmp_path / "copy"
    shutil.copytree(tiny_run, folder)
    for name in (*checkpoints.WEIGHTS, "text/tokenizer.json", "text/config.json", "card.json"):
        shutil.copytree(tiny_run, folder, dirs_exist_ok=True)
        (folder / name).write_bytes(pickle.dumps(Bomb()))
        with pytest.raises(ValueError):
            checkpoints.load_checkpoint(folder)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    "name, error, message",
    [
        ("", ValueError, "empty"),
        (".", ValueError, "folder"),
        ("x.mp3", ValueError, "ends in .mp3"),
        ("x", ValueError, "ends in nothing"),
        ("no/x.npy", FileNotFoundError, "does not exist"),
        ("there.npy", FileExistsError, "exists already"),
    ],
)
def test_check_output_refuses(name, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.npy").write_text("mine")
    with pytest.raises(error, match=message):
        check_output(name, (".npy", ".gif"))
    assert check_output("there.npy", (".npy",), force=True).name == "there.npy"
    assert check_output("New.NPY", (".npy",)).name == "New.NPY"
    assert [p.name for p in tmp_path.iterdir()] == ["there.npy"]


def test_parts_that_two_checkpoints_have_in_common_are_shipped_once(tiny_run, tmp_path):
    first, second = checkpoints.ship(tiny_run, tmp_path / "a"), checkpoints.ship(tiny_run, tmp_path / "b", beside="a")
    assert sorted(path.name for path in second.iterdir()) == ["card.json", "dit.safetensors"]
    motions = [MotionPipeline.from_pretrained(folder)("a person walks", 24, num_steps=2) for folder in (first, second)]
    assert np.array_equal(motions[0].joints, motions[1].joints)
    moved = tmp_path / "alone" / "b"
    shutil.copytree(second, moved)
    with pytest.raises(FileNotFoundError, match="lacks"):
        checkpoints.load_checkpoint(moved)
    card = json.loads((second / "card.json").read_text(encoding="utf-8"))
    for wrong in ("../a", "..", "", 7, "/etc"):
        text = json.dumps({**card, "shared": {"vae": wrong, "text": "a"}})
        (second / "card.json").write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match="beside"):
            checkpoints.load_checkpoint(second)
    (second / "card.json").write_text(json.dumps(card), encoding="utf-8")
    stats, note = checkpoints.load_tensors(first / "stats.safetensors")
    checkpoints.save_tensors(first / "stats.safetensors", {k: v + 1 for k, v in stats.items()}, note)
    with pytest.raises(ValueError, match="changed or mixed in"):
        checkpoints.load_checkpoint(second)
