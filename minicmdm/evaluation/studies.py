"""Studies: many small models or many spoilt motions, one CSV each, and the table that a CSV says.

    python -m minicmdm.evaluation.studies vae         three VAEs, three seeds: does the order of CMDM's Table 4 hold?
    python -m minicmdm.evaluation.studies agreement   do R@3 and FID track what the oracle sees?
    python -m minicmdm.evaluation.studies hearing     which mistakes in a caption the judges notice
    python -m minicmdm.evaluation.studies dimensions  noise where a skeleton shows it, and elsewhere (MARDM Table 3)

Each row is written as soon as it is measured, and rows that are there already are not measured again: a study that was
stopped goes on. The CSVs of the project are in minicmdm/assets/studies, and `--print` shows what they say.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

from minicmdm.config import Preset, preset
from minicmdm.data import grammar
from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import features_to_joints, joints_to_features, mirror_joints
from minicmdm.data.programs import FIELDS, Program
from minicmdm.evaluation import metrics
from minicmdm.evaluation.evaluators import embed, load_bench, near_miss
from minicmdm.evaluation.protocols import reconstruction, text_to_motion
from minicmdm.motion import Motion
from minicmdm.pipeline import ASSETS, MotionPipeline

STUDIES = ASSETS / "studies"
PROMPTS = 512  # of the 1,024: half the time, and intervals come from seeds
SEEDS = (0, 1, 2)
KEYS = ("oracle_accuracy", "r_at_1", "r_at_3", "fid", "skating_ratio")
Row = dict[str, str | float]


# --- small models ---------------------------------------------------------------------------------------------------


def micro(scratch: Path, name: str, plan: Preset, seed: int, vae_from: Path | None = None) -> MotionPipeline:
    """Train the micro preset on the shipped teacher and, if given, the VAE of another run; or load what is there."""
    from minicmdm.training.stages import train

    out = scratch / f"{name}-{seed}"
    if not (out / "dit.safetensors").is_file():
        (out / "text").mkdir(parents=True, exist_ok=True)
        for file in ("tmr.safetensors", "text/tokenizer.json", "text/config.json", "text/model.safetensors"):
            shutil.copyfile(ASSETS / "toy" / file, out / file)
        if vae_from is None:
            train(plan, out, stage="vae", seed=seed, resume=True, progress=False)
        else:
            for file in ("vae.safetensors", "stats.safetensors"):
                shutil.copyfile(vae_from / file, out / file)
        train(plan, out, stage="dit", seed=seed, resume=True, progress=False)
    return MotionPipeline.from_pretrained(out)


def vae_rows(scratch: Path) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """CMDM Table 4, first rows: a VAE that looks ahead, a causal one, a causal one aligned with the teacher."""
    plan, bench = preset("micro"), load_bench()
    for seed in SEEDS:
        for name, causal, weight in (("VAE", False, 0.0), ("C-VAE", True, 0.0), ("MAC-VAE", True, 0.1)):
            own = replace(plan, vae=replace(plan.vae, causal=causal), train=replace(plan.train, align_weight=weight))

            def measure(name=name, own=own, seed=seed) -> Row:
                pipe = micro(scratch, name, own, seed)
                asked = text_to_motion(pipe, bench, repeats=1, limit=PROMPTS, progress=False)["metrics"]
                back = reconstruction(pipe, bench, limit=PROMPTS, progress=False)["metrics"]
                return {key: asked[key]["mean"] for key in KEYS} | {"mpjpe_mm": back["mpjpe_mm"]["mean"]}

            yield {"model": name, "seed": seed}, measure


# --- spoilt motions -------------------------------------------------------------------------------------------------


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


# --- CSVs and what they say -----------------------------------------------------------------------------------------

ROWS = {"vae": vae_rows, "agreement": agreement_rows, "dimensions": dimension_rows, "hearing": hearing_rows}


def run(name: str, folder: Path, scratch: Path) -> list[Row]:
    """Measure what `folder`/NAME.csv lacks, row by row; return all rows."""
    path, done = folder / f"{name}.csv", read(name, folder)
    folder.mkdir(parents=True, exist_ok=True)
    for label, measure in ROWS[name](scratch):
        if any(all(str(row[key]) == str(value) for key, value in label.items()) for row in done):
            continue
        done.append({**label, **{key: float(f"{value:.5g}") for key, value in measure().items()}})
        print(done[-1], flush=True)
        with open(path, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, done[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(done)
    return done


def read(name: str, folder: Path = STUDIES) -> list[Row]:
    """The rows of a study's CSV, numbers as text; none if it has not been run."""
    path = folder / f"{name}.csv"
    if not path.is_file():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def summary(name: str, rows: list[Row]) -> str:
    """A study in a few lines: means and 95 % intervals over seeds, correlations, or the rows themselves."""
    if name == "vae":
        keys = [key for key in rows[0] if key not in ("model", "seed")]
        lines = [f"{'':8} " + "".join(f"{key:>24}" for key in keys)]
        for model in dict.fromkeys(row["model"] for row in rows):
            cells = [interval([float(row[key]) for row in rows if row["model"] == model]) for key in keys]
            lines.append(f"{model:8} " + "".join(f"{cell:>24}" for cell in cells))
        return "\n".join(lines)
    widths = {key: max(len(key), *(len(str(row[key])) for row in rows)) for key in rows[0]}
    lines = ["  ".join(f"{key:>{width}}" for key, width in widths.items())]
    lines += ["  ".join(f"{row[key]!s:>{width}}" for key, width in widths.items()) for row in rows]
    if name == "agreement":
        truth = np.array([float(row["oracle_accuracy"]) for row in rows])
        for key in ("r_at_1", "r_at_3", "fid", "mm_dist", "clip_score"):
            values = np.array([float(row[key]) for row in rows])
            lines.append(f"rank correlation of {key} with oracle accuracy: {correlation(truth, values)}")
    return "\n".join(lines)


def interval(values: list[float]) -> str:
    """Mean ± 95 % interval of a few seeds, by Student's t: with three seeds 1.96 standard errors would be too few."""
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return f"{np.mean(values):.4g} ± {half:.2g}"


def correlation(truth: np.ndarray, values: np.ndarray) -> str:
    """Spearman's rank correlation over models, with the interval of 2,000 bootstrap draws of the models."""
    rng, found = np.random.default_rng(0), []
    for _ in range(2000):
        chosen = rng.integers(len(truth), size=len(truth))
        if len(set(truth[chosen])) > 2 and len(set(values[chosen])) > 2:
            found.append(stats.spearmanr(truth[chosen], values[chosen])[0])
    low, high = np.percentile(found, [2.5, 97.5])
    return f"{stats.spearmanr(truth, values)[0]:+.2f} [{low:+.2f}, {high:+.2f}], {len(truth)} models"


def main() -> None:
    """Run a study and say what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", choices=tuple(ROWS))
    parser.add_argument("--out", type=Path, default=STUDIES, help="folder of the CSV")
    parser.add_argument("--scratch", type=Path, default=Path("runs/micro"), help="folder of the models it trains")
    parser.add_argument("--print", action="store_true", help="only say what the CSV holds")
    arguments = parser.parse_args()
    rows = read(arguments.study, arguments.out)
    if not arguments.print:
        rows = run(arguments.study, arguments.out, arguments.scratch)
    print(summary(arguments.study, rows) if rows else f"no rows yet in {arguments.out}")


if __name__ == "__main__":
    main()
