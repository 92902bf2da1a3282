"""The protocols: how a pipeline is asked and judged. One dictionary of plain values comes out.

    print(table(evaluate(MotionPipeline.from_pretrained("toy"), repeats=5)))

Under "metrics" each key of `metrics.ARROWS` holds four numbers:

    mean, ci95   the pipeline's, over repeats
    gt           the true test motions', with the same captions in the same pools
    floor        those of fresh syntheses of the same programs

The floor is what a perfect model would score, for it too answers with another motion than the one in the test set: the
truth's FID is 0, and nobody reaches it. "fields" holds the same four for each field of the oracle's accuracy.

Real data has captions but no programs: nothing for the oracle to check, and nobody to act them out afresh. Then the
oracle's rows are left out, and the floor is None.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from minicmdm.asking import sampling_of
from minicmdm.data.clips import MotionDataset
from minicmdm.data.dataset import Clip, make_clip, toy_dataset, world_fingerprint
from minicmdm.data.features import features_to_joints
from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import FIELDS, Program
from minicmdm.evaluation import metrics
from minicmdm.evaluation.evaluators import Evaluator, embed, load_bench
from minicmdm.pipeline import MotionPipeline

Bench = Mapping[str, Evaluator]
PROTOCOLS = ("t2m", "recon")
HORIZONS = {"long": (16, 8), "mtt": (64, 3)}  # compositions, prompts in each; full size is (64, 32) and (500, 3)
JUDGE = "t2m_essential"
POOL = 32  # how many motions a text is to find its own among
TEXTS, SAMPLES = 32, 10  # of MultiModality
AT_ONCE = 64  # motions in a batch
AFRESH = 1_000_000  # the number of the first fresh synthesis, beyond every split


def evaluate(
    pipe: MotionPipeline,
    bench: Bench | None = None,
    protocol: str | None = None,
    *,
    checkpoint: str = "",
    data: MotionDataset | None = None,
    evaluator: str = JUDGE,
    repeats: int = 5,
    limit: int | None = None,
    compositions: int | None = None,
    prompts_each: int | None = None,
    progress: bool = True,
    **sampling: str | int | float,
) -> dict:
    """Run a protocol, "t2m", "recon", "long" or "mtt", or the first two when none is named, merged into one result.

    `bench` holds the judges (default: the shipped ones, who know the toy world alone), `data` is another test set (for
    the first two protocols) in place of the toy world's, `checkpoint` is the name that the result carries, `sampling`
    goes to `text_to_motion` (schedule, num_steps, uncertainty, guidance_scale) or, with `compositions` and
    `prompts_each`, to `horizon.timelines`. ValueError for what cannot be asked.
    """
    start = time.perf_counter()
    check(protocol, evaluator, repeats, limit, compositions, prompts_each)
    wanted = PROTOCOLS if protocol is None else (protocol,)
    if sampling and wanted == ("recon",):
        raise ValueError(f"reconstruction samples nothing, so {', '.join(sampling)} has no meaning there")
    if data is not None and protocol in HORIZONS:
        raise ValueError(f"the protocol {protocol} is made of toy programs: for other data take t2m or recon")
    bench, common = bench or load_bench(), {"evaluator": evaluator, "limit": limit, "progress": progress}
    parts = []
    if "t2m" in wanted:
        parts.append(text_to_motion(pipe, bench, data=data, repeats=repeats, **common, **sampling))
    if "recon" in wanted:
        parts.append(reconstruction(pipe, bench, data=data, **common))
    if protocol in HORIZONS:
        from minicmdm.evaluation.horizon import timelines  # which is made of what is here

        sizes = {"compositions": compositions, "prompts_each": prompts_each}
        parts.append(timelines(pipe, bench, protocol, repeats=repeats, **sizes, **common, **sampling))
    own = {"protocol": "+".join(wanted), "checkpoint": checkpoint, "seconds": round(time.perf_counter() - start, 1)}
    own["metrics"] = {key: value for part in parts for key, value in part["metrics"].items()}
    return {**parts[0], **own}  # where both have a word, as for repeats, it is text-to-motion's


def check(
    protocol: str | None = None,
    evaluator: str = JUDGE,
    repeats: int = 1,
    limit: int | None = None,
    compositions: int | None = None,
    prompts_each: int | None = None,
) -> None:
    """Raise ValueError for a protocol, judge, number of repeats or size that `evaluate` could not work with."""
    if protocol not in (None, *PROTOCOLS, *HORIZONS):
        named = f"{' or '.join(PROTOCOLS)}, {' or '.join(HORIZONS)}, or none for the first two"
        raise ValueError(f"unknown protocol {protocol!r}: expected {named}")
    if protocol in HORIZONS:
        sizes = zip((compositions, prompts_each), HORIZONS[protocol])
        many, each = (usual if own is None else own for own, usual in sizes)
        if many < 1 or each < 2 or many * each < POOL:
            least = f"compositions of at least 2 prompts, and {POOL} prompts in all, one pool of R-precision"
            raise ValueError(f"the protocol {protocol} needs {least}, and {many} of {each} came")
    elif (compositions, prompts_each) != (None, None):
        raise ValueError(f"compositions and their prompts are for the protocols {' and '.join(HORIZONS)} alone")
    if evaluator not in ("t2m", "t2m_essential"):
        raise ValueError(f"unknown evaluator {evaluator!r}: expected t2m (263 features) or t2m_essential (67)")
    if repeats < 1:
        raise ValueError(f"repeats must be at least 1, and {repeats} came")
    if limit is not None and limit < POOL:
        raise ValueError(f"limit must be at least {POOL} clips, one pool of R-precision, and {limit} came")


def text_to_motion(
    pipe: MotionPipeline,
    bench: Bench,
    *,
    data: MotionDataset | None = None,
    evaluator: str = JUDGE,
    schedule: str | None = None,
    num_steps: int | None = None,
    uncertainty: int | None = None,
    guidance_scale: float = 3.0,
    solver: str | None = None,
    repeats: int = 5,
    limit: int | None = None,
    progress: bool = True,
) -> dict:
    """Answer every test clip of `data` or the toy world, or the first `limit`, `repeats` times; see the module's head.

    Each repeat draws a caption and a seed for each clip, and the pools of 32. Motions get the length of their clip, as
    everywhere in this field. MultiModality is taken once: 32 texts, 10 motions each; the truth has one motion a text
    and so no `gt`, and the floor's motions differ in length too. Source: Guo et al. 2022; MARDM's evaluation.
    """
    check("t2m", evaluator, repeats, limit)
    ask = {**sampling_of(pipe, schedule, num_steps, uncertainty), "guidance_scale": guidance_scale, "solver": solver}
    ask = {key: value for key, value in ask.items() if value is not None}
    pipe(["a person stands"], [4], seed=[0], **ask)  # what the pipeline refuses, it refuses here
    clips, told, fingerprint = _test_set(data, limit, progress)
    judges = [bench[evaluator], bench["clip_essential"]]
    seen = {"gt": _see(judges, clips)}
    if told:
        again = enumerate(tqdm(clips, "making them afresh", disable=not progress))
        seen["floor"] = _see(judges, [_afresh(clip, k) for k, clip in again])
    rows: dict[str, list[dict[str, float]]] = {"model": [], "gt": [], "floor": []}
    texts = min(TEXTS, len(clips))
    batches = repeats * -(-len(clips) // AT_ONCE) + -(-texts * SAMPLES // AT_ONCE)
    with tqdm(desc="answering", total=batches, unit="batch", disable=not progress) as bar:
        for repeat in range(repeats):
            rng = np.random.default_rng(repeat)
            asked = [replace(clip, captions=[clip.captions[rng.integers(len(clip.captions))]]) for clip in clips]
            seen["model"] = _see(judges, _answers(pipe, asked, rng, ask, bar))
            draw = int(rng.integers(2**31))  # the same pools and pairs for all three
            for name in seen:
                rows[name].append(_score(seen[name], seen["model"].texts, seen["gt"], clips, draw))
            if repeat == 0:
                asked = [asked[i] for i in rng.choice(len(asked), texts, replace=False) for _ in range(SAMPLES)]
                made = [_answers(pipe, asked, rng, ask, bar)]
                made += [[_afresh(clip, len(clips) + k) for k, clip in enumerate(asked)]] * told
                some = [_embed(judges[0], motions)[1].reshape(texts, SAMPLES, -1) for motions in made]
                spread = [metrics.multimodality(points, np.random.default_rng(draw)) for points in some]
                modes = _entry(spread[:1], floor=spread[1:])
    summary = {key: _entry(*([row[key] for row in rows[name]] for name in rows)) for key in rows["gt"][0]}
    fields = {key: summary.pop(key) for key in FIELDS if key in summary}
    facts = {"protocol": "t2m", "evaluator": evaluator, "clips": len(clips), "pool": min(POOL, len(clips))}
    facts |= {"fingerprint": fingerprint, "repeats": repeats, **ask}
    return {**facts, "metrics": summary | {"multimodality": modes}, "fields": fields}


def reconstruction(
    pipe: MotionPipeline,
    bench: Bench,
    *,
    data: MotionDataset | None = None,
    evaluator: str = JUDGE,
    limit: int | None = None,
    progress: bool = True,
) -> dict:
    """Send the test clips, as in `text_to_motion`, through the VAE and back: what can its latents hold at all?

    Errors are means over frames, in mm (`accel_mm` in mm / frame^2). Posterior means are used and nothing is drawn, so
    one pass is all; and as the answer is the very motion, the truth is what a perfect VAE scores and `floor` is None.
    """
    check("recon", evaluator, limit=limit)
    clips, told, fingerprint = _test_set(data, limit, progress)
    bar = tqdm(clips, "rebuilding", disable=not progress)
    rebuilt = [replace(clip, features=pipe.reconstruct(clip.features)) for clip in bar]
    truth = [replace(clip, features=clip.features[: len(one.features)]) for clip, one in zip(clips, rebuilt)]
    a, b = ([features_to_joints(clip.features.astype(np.float64)) for clip in some] for some in (rebuilt, truth))
    jump = np.average([metrics.accel(x, y) for x, y in zip(a, b)], weights=[len(x) - 2 for x in a])
    together = np.concatenate(a), np.concatenate(b)  # (frames of all clips,22,3)
    found, real = (_see([bench[evaluator]], some) for some in (rebuilt, truth))
    measured = {
        "mpjpe_mm": _entry([1000 * metrics.mpjpe(*together)], [0.0]),
        "pa_mpjpe_mm": _entry([1000 * metrics.pa_mpjpe(*together)], [0.0]),
        "accel_mm": _entry([1000 * jump], [0.0]),
        "recon_fid": _entry([metrics.frechet_distance(found.motions[0], real.motions[0])], [0.0]),
    }
    if told:
        right, own = (metrics.segment_accuracy([c.program for c in clips], seen.programs) for seen in (found, real))
        measured["recon_oracle_accuracy"] = _entry([right], [own])
    facts = {"protocol": "recon", "evaluator": evaluator, "clips": len(clips), "fingerprint": fingerprint}
    return {**facts, "repeats": 1, "schedule": None, "metrics": measured}


def table(result: Mapping) -> str:
    """A result as an aligned text table: one metric a row; the model with its interval, the ground truth, the floor."""
    rows = [("", "", "model", "GT", "floor")]
    named = {key: (key.removeprefix("recon_"), entry) for key, entry in result["metrics"].items()}
    named |= {f"fields.{key}": ("oracle_accuracy", entry) for key, entry in result.get("fields", {}).items()}
    for name, (key, entry) in named.items():
        gt, floor = ("-" if entry[k] is None else f"{entry[k]:.4f}" for k in ("gt", "floor"))
        rows.append((name, metrics.ARROWS[key], f"{entry['mean']:.4f} ± {entry['ci95']:.4f}", gt, floor))
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    lines = ["  ".join(f"{cell:{'<' if k < 2 else '>'}{widths[k]}}" for k, cell in enumerate(row)) for row in rows]
    words = [f"{k} {v}" for k, v in result.items() if not isinstance(v, dict) and v not in (None, "")]
    return "\n".join([", ".join(words), "", *lines])


def _test_set(data: MotionDataset | None, limit: int | None, progress: bool) -> tuple[list[Clip], bool, str]:
    """The clips to answer, whether they have programs, and the fingerprint of where they are from."""
    if data is None:
        return toy_dataset("test", limit, progress).clips, True, world_fingerprint()
    clips = data.clips[:limit]
    if len(clips) < 4:
        raise ValueError(f"a test set needs at least 4 clips to be told apart, and {len(clips)} came")
    return clips, all(clip.program for clip in clips), data.fingerprint


@dataclass(frozen=True)
class Seen:
    """What is known of N clips: texts and motions (N,E) as each judge places them, what was done, how much it slid."""

    texts: list[np.ndarray]
    motions: list[np.ndarray]
    programs: list[Program]  # none, where nobody knows what was asked
    skating: float


def _see(judges: list[Evaluator], clips: list[Clip]) -> Seen:
    texts, motions = zip(*[_embed(judge, clips) for judge in judges])
    joints = [features_to_joints(clip.features) for clip in clips]
    programs = [tuple(read_motion(one)) for one in joints] if all(clip.program for clip in clips) else []
    return Seen(texts, motions, programs, float(np.mean([metrics.skating_ratio(one) for one in joints])))


def _embed(judge: Evaluator, clips: list[Clip]) -> tuple[np.ndarray, np.ndarray]:
    return embed(judge, [clip.captions[0] for clip in clips], [clip.features for clip in clips])


def _afresh(clip: Clip, number: int) -> Clip:
    """The clip with its program acted out once more, with other luck: another length, the same words."""
    return replace(clip, features=make_clip("val", AFRESH + number, clip.program).features)


def _answers(pipe: MotionPipeline, asked: list[Clip], rng, ask: dict, bar: tqdm) -> list[Clip]:
    """The clips with the pipeline's motions to their first captions, at their lengths, each with a seed of its own."""
    seeds = rng.integers(2**31, size=len(asked)).tolist()
    order = sorted(range(len(asked)), key=lambda i: len(asked[i].features))  # like lengths together: little padding
    made: dict[int, Clip] = {}
    for chosen in (order[first : first + AT_ONCE] for first in range(0, len(order), AT_ONCE)):
        words, frames = zip(*[(asked[i].captions[0], len(asked[i].features)) for i in chosen])
        motions = pipe(words, frames, seed=[seeds[i] for i in chosen], **ask)
        made |= {i: replace(asked[i], features=motion.features) for i, motion in zip(chosen, motions)}
        bar.update()
    return [made[i] for i in range(len(asked))]


def _score(seen: Seen, texts: list[np.ndarray], truth: Seen, clips: list[Clip], draw: int) -> dict[str, float]:
    """One repeat's numbers for one set of motions: those of `metrics.ARROWS`, and one for each field."""
    rng = np.random.default_rng(draw)
    asked = [clip.program for clip in clips]
    heldout = [(clip.program, found) for clip, found in zip(clips, seen.programs) if clip.kind == "pairs"]
    pool = min(POOL, len(clips))
    right = {"oracle_accuracy": metrics.segment_accuracy(asked, seen.programs)} if seen.programs else {}
    if heldout:
        right["oracle_accuracy_heldout"] = metrics.segment_accuracy(*zip(*heldout))
    return {
        **right,
        **dict(zip(("r_at_1", "r_at_2", "r_at_3"), metrics.r_precision(texts[0], seen.motions[0], pool, rng))),
        "mm_dist": metrics.mm_distance(texts[0], seen.motions[0]),
        "fid": metrics.frechet_distance(seen.motions[0], truth.motions[0]),
        "diversity": metrics.diversity(seen.motions[0], rng),
        "clip_score": metrics.clip_score(texts[1], seen.motions[1]),
        "skating_ratio": seen.skating,
        **(metrics.field_accuracy(asked, seen.programs) if seen.programs else {}),
    }


def _entry(values: list[float], gt: Sequence[float] = (), floor: Sequence[float] = ()) -> dict[str, float | None]:
    """The contract's four numbers; None where nothing was measured."""
    mean, ci95 = metrics.confidence(values)
    beside = {name: float(np.mean(v)) if len(v) else None for name, v in (("gt", gt), ("floor", floor))}
    return {"mean": mean, "ci95": ci95, **beside}
