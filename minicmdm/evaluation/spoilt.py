"""Studies of the judges: what do they say of motions, and of captions, that are spoilt in a way we know?

    agreement   models of every quality: do R@3 and FID track what the oracle sees?
    hearing     captions with a single thing wrong: which mistakes do the judges notice?
    dimensions  noise where a skeleton shows it, and elsewhere (MARDM Table 3)

`python -m minicmdm.evaluation.studies NAME` runs them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from minicmdm.config import preset
from minicmdm.data import grammar
from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import features_to_joints, joints_to_features, mirror_joints
from minicmdm.data.programs import FIELDS, Program
from minicmdm.evaluation import metrics
from minicmdm.evaluation.evaluators import embed, load_bench
from minicmdm.evaluation.pairs import near_miss
from minicmdm.evaluation.protocols import text_to_motion
from minicmdm.evaluation.small import KEYS, PROMPTS, Row, micro
from minicmdm.motion import Motion
from minicmdm.pipeline import MotionPipeline


class Spoilt:
    """A pipeline whose motions, or whose hearing, is spoilt in one way. It answers a question only once."""

    known: dict[tuple, np.ndarray] = {}

    def __init__(self, pipe: MotionPipeline, how: str, amount: float = 0.0):
        self.pipe, self.how, self.amount = pipe, how, amount

    def __call__(self, prompts, frames, *, seed, **ask) -> list[Motion]:
        rng = np.random.default_rng(seed[0])
        prompts = list(prompts)
        if self.how == "hears another":
            some = np.flatnonzero(rng.random(len(prompts)) < self.amount)
            for i, other in zip(some, [prompts[j] for j in np.roll(some, 1)]):
                prompts[i] = other
        keys = [(id(self.pipe), *one, *ask.values()) for one in zip(prompts, frames, seed)]
        new = [k for k, key in enumerate(keys) if key not in self.known]
        if new:
            fresh = self.pipe([prompts[k] for k in new], [frames[k] for k in new], seed=[seed[k] for k in new], **ask)
            self.known.update({keys[k]: motion.features for k, motion in zip(new, fresh)})
        spoilt = [self.spoil(self.known[key], rng) for key in keys]
        return [Motion(features_to_joints(x), x, text) for x, text in zip(spoilt, prompts)]

    def spoil(self, features: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        std = self.pipe.stats["feature_std"].numpy()
        if self.how == "trembles":
            return (features + self.amount * std * rng.standard_normal(features.shape)).astype(np.float32)
        if self.how == "freezes":
            return np.repeat(features[len(features) // 2][None], len(features), axis=0) * (std > 0)
        if self.how in ("is mirrored", "runs backwards", "is slow"):
            joints = features_to_joints(features)
            if self.how == "is mirrored":
                joints = mirror_joints(joints)
            elif self.how == "runs backwards":
                joints = joints[::-1]
            else:
                joints = joints[np.linspace(0, self.amount * (len(joints) - 1), len(joints)).round().astype(int)]
            return joints_to_features(np.concatenate([joints, joints[-1:]])).astype(np.float32)
        return features


def agreement_rows(scratch: Path) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """Models of every quality: micro ones after more and more steps, the shipped one, and the shipped one spoilt."""
    bench, plan = load_bench(), preset("micro")

    def measured(make: Callable[[], object], **ask) -> Callable[[], Row]:
        def measure() -> Row:
            found = text_to_motion(make(), bench, repeats=1, limit=PROMPTS, progress=False, **ask)["metrics"]
            return {key: found[key]["mean"] for key in (*KEYS, "mm_dist", "clip_score")}

        return measure

    for steps in (100, 200, 400, 800):
        few = replace(plan, train=replace(plan.train, dit_steps=steps, dit_warmup=50))
        made = lambda few=few, steps=steps: micro(scratch, f"dit{steps}", few, 0, scratch / "MAC-VAE-0")  # noqa: E731
        yield {"model": f"micro, {steps} steps"}, measured(made)
    yield {"model": "micro, 1500 steps"}, measured(lambda: micro(scratch, "MAC-VAE", plan, 0))
    shipped = MotionPipeline.from_pretrained("toy")
    yield {"model": "shipped"}, measured(lambda: Spoilt(shipped, "is whole"))
    yield {"model": "shipped, guidance 1"}, measured(lambda: shipped, guidance_scale=1.0)
    yield {"model": "shipped, 4 steps"}, measured(lambda: shipped, num_steps=4, uncertainty=1)
    spoils = [("hears another", 0.2), ("hears another", 0.5), ("trembles", 0.05), ("trembles", 0.2), ("freezes", 0.0)]
    spoils += [("is mirrored", 0.0), ("runs backwards", 0.0), ("is slow", 0.7)]
    for how, amount in spoils:
        name = f"shipped, {how}" + (f" {amount:g}" if amount else "")
        yield {"model": name}, measured(lambda how=how, amount=amount: Spoilt(shipped, how, amount))


def dimension_rows(scratch: Path) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """MARDM Table 3 on toy data: Gaussian noise on the true features, essential (first 67) or redundant (the rest)."""
    clips, bench = toy_dataset("test").clips, load_bench()
    std = toy_dataset("train", 256).std
    texts = [clip.captions[0] for clip in clips]
    truth = {name: embed(bench[name], texts, [clip.features for clip in clips])[1] for name in ("t2m", "t2m_essential")}
    for where, columns in (("essential", slice(0, 67)), ("redundant", slice(67, 263))):
        for sigma in (0.0, 0.1, 0.2, 0.5, 1.0):

            def measure(columns=columns, sigma=sigma) -> Row:
                rng, noisy, row = np.random.default_rng(0), [], {}
                for clip in clips:
                    x = clip.features.copy()
                    x[:, columns] += sigma * std[columns] * rng.standard_normal(x[:, columns].shape).astype(np.float32)
                    noisy.append(x)
                for name in truth:
                    text, motion = embed(bench[name], texts, noisy)
                    row[f"fid {name}"] = metrics.frechet_distance(motion, truth[name])
                    row[f"r_at_3 {name}"] = metrics.r_precision(text, motion, 32)[2]
                return row

            yield {"noise in": where, "sigma": sigma}, measure


def hearing_rows(scratch: Path) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """What the judges hear: how often a motion is nearer to its caption than to one with a single thing wrong."""
    clips, bench = toy_dataset("test").clips, load_bench()
    rng, missed = np.random.default_rng(0), {}
    for clip in clips:
        if (miss := near_miss(clip.program, rng)) is not None:
            missed.setdefault(_difference(clip.program, miss), []).append((clip, grammar.caption(rng, miss)))
    for what, pairs in sorted(missed.items()):

        def measure(pairs=pairs) -> Row:
            row, motions = {"pairs": len(pairs)}, [clip.features for clip, _ in pairs]
            for name, judge in bench.items():
                right, motion = embed(judge, [clip.captions[0] for clip, _ in pairs], motions)
                wrong = embed(judge, [text for _, text in pairs], motions)[0]
                near = [np.linalg.norm(text - motion, axis=1) for text in (right, wrong)]
                row[name] = float((near[0] < near[1]).mean())
            return row

        yield {"wrong": what}, measure


def _difference(program: Program, other: Program) -> str:
    if [s.action for s in program] != [s.action for s in other]:
        return "order"
    return next(key for key in FIELDS for a, b in zip(program, other) if getattr(a, key) != getattr(b, key))
