"""The quick protocol: does the motion do what its sentence asked? One flat dictionary of numbers.

Every test prompt of the toy world is answered once (its own length, its own seed) and read by the oracle. Beside the
model stand the truth (what the oracle reads from the synthesised test motions), a baseline that owns no model (the
training clip whose caption has the nearest words) and the model itself with the words of each sentence shuffled: a
world is hard enough when the baseline fails and the order of the words matters.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from minicmdm.asking import sampling_of
from minicmdm.data.dataset import Clip, toy_dataset, world_fingerprint
from minicmdm.data.features import features_to_joints
from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import Program
from minicmdm.evaluation.metrics import clip_accuracy, field_accuracy, mpjpe, segment_accuracy

if TYPE_CHECKING:
    from minicmdm.pipeline import MotionPipeline

SHUFFLED = 256  # prompts that are also answered with their words shuffled
AT_ONCE = 64  # prompts in a batch


def evaluate_quick(
    pipe: MotionPipeline,
    progress: bool = True,
    limit: int | None = None,
    *,
    schedule: str | None = None,
    num_steps: int | None = None,
    uncertainty: int | None = None,
    guidance_scale: float = 3.0,
) -> dict[str, float | int | str]:
    """Judge a pipeline on the first `limit` test prompts (default: all 1,024): shares of right segments, 0 to 1.

    `oracle_accuracy` is right segments / max(asked, found), every stated field, in order; `_clip` counts whole clips;
    `_heldout` are the clips with action pairs never seen in training, `_paraphrase` those told in unseen phrases;
    `_gt` is the truth's own score, `_nearest` the baseline's whole clips on ordinary prompts; `mpjpe_mm` the VAE's
    reconstruction error, pelvis-aligned. Progress goes to stderr.
    """
    start, plan = time.perf_counter(), sampling_of(pipe, schedule, num_steps, uncertainty)
    clips = toy_dataset("test", limit, progress).clips
    asked = [clip.program for clip in clips]
    truth = [_read(features_to_joints(clip.features)) for clip in clips]

    def answers(prompts: list[str], which: list[int], note: str) -> list[Program]:
        out: dict[int, Program] = {}
        order = sorted(which, key=lambda i: len(clips[i].features))
        chunks = [order[k : k + AT_ONCE] for k in range(0, len(order), AT_ONCE)]
        for chunk in _bar(chunks, note, progress):
            motions = pipe(
                [prompts[i] for i in chunk],
                [len(clips[i].features) for i in chunk],
                **plan,
                guidance_scale=guidance_scale,
                seed=[1000 + i for i in chunk],
            )
            out.update(zip(chunk, (_read(m.joints) for m in motions)))
        return [out[i] for i in which]

    prompts = [clip.captions[0] for clip in clips]
    everything = list(range(len(clips)))
    found = answers(prompts, everything, "answering")
    some = everything[:SHUFFLED]
    rng = np.random.default_rng(0)
    mixed = answers([_shuffle(rng, p) for p in prompts], some, "words shuffled")
    near = nearest_words(clips, toy_dataset("train", progress=progress).clips)

    def kind(name: str) -> list[int]:
        return [i for i in everything if clips[i].kind == name]

    def share(readings: list[Program], which: list[int]) -> float:
        return segment_accuracy([asked[i] for i in which], [readings[i] for i in which])

    def whole(readings: list[Program], which: list[int]) -> float:
        return clip_accuracy([asked[i] for i in which], [readings[i] for i in which])

    ordinary, pairs = kind("ordinary"), kind("pairs")
    numbers = {
        "oracle_accuracy": share(found, everything),
        "oracle_accuracy_ordinary": share(found, ordinary),
        "oracle_accuracy_paraphrase": share(found, kind("paraphrase")),
        "oracle_accuracy_heldout": share(found, pairs),
        "oracle_accuracy_clip": whole(found, everything),
        "oracle_accuracy_clip_ordinary": whole(found, ordinary),
        "oracle_accuracy_gt": share(truth, everything),
        "oracle_accuracy_nearest": whole(near, ordinary),
        "oracle_accuracy_nearest_heldout": whole(near, pairs),
        "oracle_accuracy_shuffled": segment_accuracy([asked[i] for i in some], mixed),
        "oracle_accuracy_unshuffled": share(found, some),  # the same prompts as _shuffled, in order
        "mpjpe_mm": float(np.mean([reconstruction_error(pipe, clip) for clip in clips])),
    }
    for parts in (1, 2, 3):
        numbers[f"oracle_accuracy_clip_{parts}_part"] = whole(found, [i for i in everything if len(asked[i]) == parts])
    numbers |= {f"field_{name}": value for name, value in field_accuracy(asked, found).items()}
    return {
        **{key: round(value, 4) for key, value in numbers.items()},
        "prompts": len(clips),
        "prompts_shuffled": len(some),
        **plan,
        "guidance_scale": guidance_scale,
        "fingerprint": world_fingerprint(),
        "seconds": round(time.perf_counter() - start, 1),
    }


def nearest_words(clips: list[Clip], train: list[Clip]) -> list[Program]:
    """The baseline: for each prompt, what the oracle reads in the training clip whose caption has the nearest words.

    Words are weighed by their rarity (tf-idf) and compared by the angle between the two bags.
    """
    captions = [(text, k) for k, clip in enumerate(train) for text in clip.captions]
    bags = [_words(text) for text, _ in captions]
    index = {word: i for i, word in enumerate(sorted({w for bag in bags for w in bag}))}

    def count(bags: list[list[str]]) -> np.ndarray:
        table = np.zeros((len(bags), len(index)), np.float32)
        for row, bag in zip(table, bags):
            for word in bag:
                if word in index:
                    row[index[word]] += 1
        return table

    table = count(bags)  # (captions, words)
    rarity = np.log(len(bags) / (table > 0).sum(0))
    known = table * rarity
    known /= np.maximum(np.linalg.norm(known, axis=1, keepdims=True), 1e-9)
    asked = count([_words(clip.captions[0]) for clip in clips]) * rarity
    best = [captions[int((known @ row).argmax())][1] for row in asked]
    return [_read(features_to_joints(train[k].features)) for k in best]


def reconstruction_error(pipe: MotionPipeline, clip: Clip) -> float:
    """Mean joint error (mm) of one clip through the VAE and back, both aligned at the pelvis in every frame."""
    rebuilt = features_to_joints(pipe.reconstruct(clip.features))  # (T,22,3)
    truth = features_to_joints(clip.features[: len(rebuilt)].astype(np.float64))
    return 1000 * mpjpe(rebuilt, truth)


def _read(joints: np.ndarray) -> Program:
    return tuple(read_motion(joints))


def _words(text: str) -> list[str]:
    return text.replace(",", " ").replace(".", " ").split()


def _shuffle(rng: np.random.Generator, text: str) -> str:
    words = text.split()
    return " ".join(words[i] for i in rng.permutation(len(words)))


def _bar(items: list, note: str, progress: bool):
    if not progress:
        return items
    from tqdm import tqdm

    return tqdm(items, desc=note, unit="batch")
