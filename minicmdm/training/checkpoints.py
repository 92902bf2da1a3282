"""Checkpoints: safetensors for the numbers, one JSON card for the words. Nothing is ever unpickled.

A checkpoint is a folder:

    tmr.safetensors     the teacher that aligned it; its text encoder is text/
    vae.safetensors     MAC-VAE (EMA weights)
    dit.safetensors     CausalDiT, or another system's transformer (EMA weights)
    text/               the text encoder: tokenizer.json, config.json, model.safetensors
    stats.safetensors   mean and std of the features (263,), and of the latents (C,)
    card.json           preset, seed, data fingerprint, metrics, seconds, version, command, and the files' checksums

Under "shared" the card may name a folder beside its own that holds the VAE or the text encoder, where two systems have
the very same.

The card is written last and names the checksum of every weight file, so a folder whose parts do not belong together
(killed between two files, or mixed by hand) is recognised and refused instead of sampled.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from minicmdm.config import Preset
from minicmdm.data.skeleton import skeleton_of
from minicmdm.files import whole_file, write_text
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import TextEncoder
from minicmdm.models.tmr import MotionTeacher
from minicmdm.models.vae import MACVAE
from minicmdm.systems import MaskedTransformer, new_denoiser

FORMAT = "minicmdm-checkpoint-1"
WEIGHTS = ("vae.safetensors", "stats.safetensors", "dit.safetensors", "text/model.safetensors")  # what a motion takes
FILES = (*WEIGHTS, "tmr.safetensors")
PARTS = {"vae": ("vae.safetensors", "stats.safetensors"), "text": ("text/model.safetensors",)}  # that may be shared
STATS = ("feature_mean", "feature_std", "latent_mean", "latent_std")


@dataclass
class Checkpoint:
    """A loaded checkpoint: models in eval mode, and the statistics (float32) that go with them."""

    preset: Preset
    vae: MACVAE
    dit: CausalDiT | MaskedTransformer
    text: TextEncoder
    stats: dict[str, Tensor]  # feature_mean, feature_std (D,); latent_mean, latent_std (C,)
    card: dict


def save_tensors(path: str | Path, tensors: Mapping[str, Tensor], note: object = None) -> None:
    """Write tensors, and a JSON-able note in the same file's header, as one whole file."""
    ready = {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}
    with whole_file(path) as temporary:
        temporary.write_bytes(safetensors.torch.save(ready, metadata={"note": json.dumps(note)}))


def load_tensors(path: str | Path) -> tuple[dict[str, Tensor], object]:
    """Read a safetensors file; return its tensors and its note (None if it has none).

    Raises FileNotFoundError if it is missing, ValueError if it is cut short, empty or no safetensors file at all.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}: a weight file in safetensors format was expected there")
    try:
        raw = path.read_bytes()  # read, not mapped: the file may be replaced while we still use the numbers
        tensors = safetensors.torch.load(raw)
        header = json.loads(raw[8 : 8 + int.from_bytes(raw[:8], "little")])
        note = json.loads(header.get("__metadata__", {}).get("note", "null"))
    except (SafetensorError, ValueError, KeyError, AttributeError, RecursionError) as error:
        size = path.stat().st_size
        raise ValueError(
            f"{path} ({size} bytes) is not a whole safetensors file: it is cut short or of another kind ({error})"
        ) from error
    return tensors, note


def load_weights(module: nn.Module, path: str | Path, more: Mapping[str, Tensor] | None = None) -> None:
    """Load a weight file into a module whose names and shapes must match exactly; teach the first difference.

    `more` holds those of the module's tensors that live elsewhere.
    """
    tensors = {**load_tensors(path)[0], **(more or {})}
    own = module.state_dict()
    for key in own.keys() | tensors.keys():
        if key not in tensors or key not in own:
            where = "the file lacks" if key not in tensors else "the file has a foreign"
            raise ValueError(
                f"{path} does not fit the model {type(module).__name__} of its card: {where} tensor {key!r}"
            )
        if own[key].shape != tensors[key].shape:
            shapes = f"{tuple(own[key].shape)} expected, {tuple(tensors[key].shape)} found"
            raise ValueError(f"{path} does not fit the model {type(module).__name__} of its card: {key!r} is {shapes}")
        if not torch.isfinite(tensors[key]).all():
            raise ValueError(f"{path}: the tensor {key!r} holds numbers that are not finite")
    module.load_state_dict(tensors)


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def save_vae(folder: Path, vae: MACVAE, stats: Mapping[str, Tensor]) -> None:
    """Write the first stage's part: the VAE and the statistics."""
    save_tensors(folder / "vae.safetensors", vae.state_dict())
    save_tensors(folder / "stats.safetensors", stats)


def save_teacher(folder: Path, teacher: MotionTeacher) -> None:
    """Write the teacher's own weights and, beside them, its text encoder, which the denoiser will read with.

    Words that were read once (wordcache.py) come from an encoder that did not learn: it lies there since the start.
    """
    own = {key: value for key, value in teacher.state_dict().items() if not key.startswith("text.")}
    save_tensors(folder / "tmr.safetensors", own)
    if isinstance(teacher.text, TextEncoder):
        save_text(folder, teacher.text)


def save_dit(folder: Path, dit: nn.Module) -> None:
    """Write the last stage's part: the denoiser."""
    save_tensors(folder / "dit.safetensors", dit.state_dict())


def save_text(folder: Path, text: TextEncoder) -> None:
    """Write the text encoder into `folder`/text: made elsewhere first, then moved in file by file, each whole."""
    (folder / "text").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as elsewhere:
        text.save(Path(elsewhere))
        for file in sorted(Path(elsewhere).iterdir()):
            with whole_file(folder / "text" / file.name) as temporary:
                temporary.write_bytes(file.read_bytes())


def ship(source: str | Path, target: str | Path, beside: str | None = None) -> Path:
    """Copy a checkpoint to the folder `target` with its weights in float16, half the size; statistics stay float32.

    That moves a weight by a two-thousandth of itself at most, and what is measured and told is measured on the copy.
    Parts that are those of the checkpoint `beside`, a folder next to the target, are left there, and so is the teacher.
    """
    source, target = Path(source), Path(target)
    card, shared = read_card(source), {}
    (target / "text").mkdir(parents=True, exist_ok=True)
    for name in card["files"]:
        tensors, note = load_tensors(source / name)
        keep = name.startswith("stats")
        save_tensors(target / name, tensors if keep else {k: v.half() for k, v in tensors.items()}, note)
    for name in ("tokenizer.json", "config.json"):
        write_text(target / "text" / name, (source / "text" / name).read_text(encoding="utf-8"))
    for part, names in PARTS.items() if beside else ():
        other = target.parent / beside
        if all(checksum(target / name) == checksum(other / name) for name in names):
            shared[part] = beside
            for name in names:
                (target / name).unlink()
    if "text" in shared:
        shutil.rmtree(target / "text")
    if beside:
        (target / "tmr.safetensors").unlink(missing_ok=True)
    facts = {key: value for key, value in card.items() if key not in ("format", "preset", "files", "shared")}
    write_card(target, read_preset(card, source), {**facts, "precision": "float16", "shared": shared})
    return target


def home(folder: Path, card: Mapping, part: str) -> Path:
    """The folder that holds a checkpoint's "vae" or "text". ValueError: a card that leads elsewhere than beside it."""
    shared = card.get("shared") or {}
    name = shared.get(part) if isinstance(shared, dict) else ""
    if name is None:
        return folder
    if not isinstance(name, str) or not name or name != Path(name).name or name in (".", ".."):
        raise ValueError(f"{folder / 'card.json'}: 'shared' names folders beside this one, and {name!r} came")
    return folder.parent / name


def _place(folder: Path, card: Mapping, name: str) -> Path:
    part = next((part for part, names in PARTS.items() if name in names), "")
    return home(folder, card, part) / name


def write_card(folder: Path, preset: Preset, facts: Mapping[str, object]) -> None:
    """Write the card last: what the weights are, how they were made, and the checksum of every weight file."""
    files = {name: checksum(path) for name in FILES if (path := _place(folder, facts, name)).is_file()}
    card = {"format": FORMAT, "preset": preset.to_dict(), **facts, "files": files}
    write_text(folder / "card.json", json.dumps(card, indent=2) + "\n")


def read_card(folder: str | Path) -> dict:
    """Read and verify a checkpoint's card and the checksums it names (FileNotFoundError, ValueError)."""
    folder = Path(folder)
    path = folder / "card.json"
    if not folder.exists():
        raise FileNotFoundError(f'no checkpoint folder {folder}: give "toy" or a folder made by `minicmdm train --out`')
    if not path.is_file():
        hint = (
            "its training has not ended, go on with `minicmdm train --resume`"
            if any(folder.glob("state_*.safetensors"))
            else "a checkpoint folder holds card.json beside its weights"
        )
        raise FileNotFoundError(f"{folder} holds no finished checkpoint (no card.json): {hint}")
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not a whole JSON file: {error}") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        found = card.get("format") if isinstance(card, dict) else type(card).__name__
        raise ValueError(
            f"{path} is not the card of a minicmdm checkpoint: format {FORMAT!r} expected, {found!r} found"
        )
    files = card.get("files")
    if not isinstance(files, dict) or not set(files) <= set(FILES):
        raise ValueError(f"{path} must name the checksums of the files {', '.join(FILES)} under 'files'")
    for name, expected in files.items():
        place = _place(folder, card, name)
        if not place.is_file():
            raise FileNotFoundError(f"the checkpoint {folder} lacks {name}, which its card names")
        if checksum(place) != expected:
            load_tensors(place)  # a cut file says so itself; a whole one is simply not the card's
            raise ValueError(f"{place} is not the file that the card describes: it was changed or mixed in")
    return card


def load_checkpoint(folder: str | Path) -> Checkpoint:
    """Load a whole checkpoint folder (FileNotFoundError or ValueError, with what was expected and what is there)."""
    folder = Path(folder)
    card = read_card(folder)
    if missing := [name for name in WEIGHTS if name not in card["files"]]:
        raise ValueError(
            f"{folder} holds a part of a checkpoint, without {', '.join(missing)}: "
            f"`minicmdm train --stage dit --out {folder}` trains what follows the VAE"
        )
    preset = read_preset(card, folder)
    vae, stats = load_vae(home(folder, card, "vae"), preset)
    dit = _build(new_denoiser, preset, folder)
    load_weights(dit, folder / "dit.safetensors")
    text = TextEncoder.load(home(folder, card, "text") / "text", preset.text)
    return Checkpoint(preset, vae, dit.eval(), text.eval(), stats, card)


def load_vae(folder: Path, preset: Preset) -> tuple[MACVAE, dict[str, Tensor]]:
    """Load the first stage's part: the VAE in eval mode and the statistics."""
    vae = _build(MACVAE, preset.vae, folder)
    load_weights(vae, folder / "vae.safetensors")
    stats, _ = load_tensors(folder / "stats.safetensors")
    for name in STATS:
        size = preset.vae.input_dim if name.startswith("feature") else preset.vae.latent_dim
        value = stats.get(name)
        if value is None or value.shape != (size,) or not torch.isfinite(value).all():
            raise ValueError(f"{folder / 'stats.safetensors'} must hold {name}: {size} finite numbers")
        if name.endswith("std") and not (value > 0).all():
            raise ValueError(f"{folder / 'stats.safetensors'}: {name} must be positive")
    return vae.eval(), stats


def load_teacher(folder: Path, preset: Preset) -> MotionTeacher:
    """Load the teacher in eval mode, with the text encoder it was trained with. It learns no more."""
    text = TextEncoder.load(folder / "text", preset.text)
    try:
        teacher = MotionTeacher(preset.tmr, text, skeleton_of(preset.vae.input_dim).num_features)
    except ValueError as error:
        raise ValueError(f"{folder / 'card.json'} describes a teacher that cannot be built: {error}") from error
    words = {f"text.{key}": value for key, value in text.state_dict().items()}
    load_weights(teacher, folder / "tmr.safetensors", words)
    return teacher.eval().requires_grad_(False)


def _build(model: Callable[..., nn.Module], config: object, folder: Path) -> nn.Module:
    try:
        return model(config)
    except (TypeError, ValueError, ArithmeticError, RuntimeError, MemoryError) as error:
        raise ValueError(
            f"{folder / 'card.json'} describes a {model.__name__} that cannot be built: {error}"
        ) from error


def read_preset(card: dict, folder: Path) -> Preset:
    """The preset that a card describes (ValueError if its fields are not those of this version)."""
    try:
        return Preset.from_dict(card["preset"])
    except (TypeError, KeyError, ValueError, ArithmeticError, AttributeError) as error:
        raise ValueError(f"{folder / 'card.json'} describes no preset that this version knows: {error}") from error
