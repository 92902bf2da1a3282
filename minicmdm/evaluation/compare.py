"""Four systems, one test set, one set of judges: `minicmdm evaluate --compare`.

Each system samples in its own way (`pipe.sampling`), at the guidance that was best for it on the validation set. Beside
the text-to-motion protocol there are

    pj auj              jerk around the seams of test motions of several parts, where the truth has its seams; AUJ's
                        reference is the mean jerk in the middle of true segments (horizon.py)
    calls               of the transformer, for 30 latents (6 s); `head_calls` those of a diffusion head besides
    first_frame_ms      until the first frame of 6 s can be shown: a system that cannot stream has to make them all
    ms_per_latent       CPU time for 6 s in one piece, over 30
    parameters          of all that takes part in sampling

Times are this machine's, one thread, the least of three.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from tqdm import tqdm

from minicmdm.data.dataset import Clip, toy_dataset
from minicmdm.data.features import features_to_joints
from minicmdm.diffusion.schedules import closed_form_cost
from minicmdm.evaluation import metrics
from minicmdm.evaluation.evaluators import load_bench
from minicmdm.evaluation.horizon import WINDOW, Take, _stood, calm
from minicmdm.evaluation.protocols import _answers, _entry, text_to_motion
from minicmdm.pipeline import SHIPPED, MotionPipeline
from minicmdm.systems import MASKED

# On the first 128 validation prompts (`python -m minicmdm.evaluation.studies guidance`); window, not shipped: flood's.
GUIDANCE = {"cmdm": 3.0, "flood": 2.0, "mardm": 3.0, "cdamd": 2.0, "window": 2.0}
LATENTS = 30
SEAMS = 128  # test clips whose seams are looked at
COLUMNS = (
    *("oracle_accuracy", "oracle_accuracy_heldout", "r_at_1", "r_at_2", "r_at_3", "fid", "mm_dist", "multimodality"),
    *("clip_score", "pj", "auj"),
)


def compare(
    names: Sequence[str] = SHIPPED, *, repeats: int = 5, limit: int | None = None, progress: bool = True
) -> dict:
    """Measure checkpoints (names or folders) alike; {"systems": [...]}, each with "metrics" as `evaluate` has them."""
    bench, systems = load_bench(), []
    for name in names:
        pipe = MotionPipeline.from_pretrained(name)
        system = pipe.preset.system
        scale = GUIDANCE[system]
        found = text_to_motion(pipe, bench, guidance_scale=scale, repeats=repeats, limit=limit, progress=progress)
        ask = {**pipe.sampling(None, None, None), "guidance_scale": scale}
        row = {"system": system, "checkpoint": name, "repeats": repeats, **ask}
        row["metrics"] = found["metrics"] | seam_jerk(pipe, ask, repeats, limit, progress)
        systems.append({**row, **price(pipe, ask)})
    return {"systems": systems}


def seam_jerk(pipe: MotionPipeline, ask: dict, repeats: int, limit: int | None, progress: bool) -> dict[str, dict]:
    """PJ and AUJ at the seams of test motions, whose place the truth tells."""
    clips = [clip for clip in toy_dataset("test", limit).clips if _seams(clip)][:SEAMS]
    truth = [_take(clip, clip) for clip in clips]
    reference = calm(truth)
    rows: dict[str, list[float]] = {"pj": [], "auj": []}
    with tqdm(desc="seams", disable=not progress) as bar:
        for repeat in range(repeats):
            made = _answers(pipe, clips, np.random.default_rng(repeat), ask, bar)
            jerks = _jerks([_take(clip, one) for clip, one in zip(clips, made)], reference)
            for key, value in jerks.items():
                rows[key].append(value)
    return {key: _entry(rows[key], [value]) for key, value in _jerks(truth, reference).items()}


def _jerks(takes: list[Take], reference: float) -> dict[str, float]:
    windows = _stood([window for take in takes for window in take.around(take.seams)])
    return {"pj": metrics.peak_jerk(windows), "auj": metrics.area_under_jerk(windows, reference)}


def _seams(clip: Clip) -> list[int]:
    """Where a whole window has room around the beginning of a segment."""
    return [start for start, _, _ in clip.labels[1:] if WINDOW // 2 <= start < len(clip.features) - WINDOW // 2 - 1]


def _take(clip: Clip, acted: Clip) -> Take:
    cuts = [0, *_seams(clip), len(clip.features) - 1]
    joints = features_to_joints(acted.features.astype(np.float64))
    return Take([], joints, list(zip(cuts[:-1], cuts[1:])))


def price(pipe: MotionPipeline, ask: dict) -> dict[str, int | float]:
    """Calls, latencies and parameters of a system, for 6 s."""
    if pipe.preset.system in MASKED:
        calls = pipe.preset.masked.iterations
        head = calls * ask["num_steps"]
    else:
        calls = closed_form_cost(LATENTS, ask["num_steps"], ask["uncertainty"], kind=ask["schedule"]).calls
        head = 0
    whole = _least(lambda: pipe("a person walks", 4 * LATENTS, **ask))
    first = whole if pipe.preset.system in MASKED else _least(lambda: next(pipe.stream("a person walks", **ask)))
    return {
        "calls": calls,
        "head_calls": head,
        "first_frame_ms": round(1000 * first, 1),
        "ms_per_latent": round(1000 * whole / LATENTS, 2),
        "parameters": sum(w.numel() for part in (pipe.vae, pipe.dit, pipe.text) for w in part.parameters()),
    }


def _least(run: Callable[[], object]) -> float:
    seconds = []
    for _ in range(3):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return min(seconds)


def table(result: dict) -> str:
    """Systems as columns, with the truth and what a perfect system would score."""
    systems = result["systems"]
    first = systems[0]["metrics"]
    rows = [("", "", *(one["system"] for one in systems), "GT", "floor")]
    for key in COLUMNS:
        cells = [f"{one['metrics'][key]['mean']:.3f} ± {one['metrics'][key]['ci95']:.3f}" for one in systems]
        ends = ["-" if first[key][k] is None else f"{first[key][k]:.3f}" for k in ("gt", "floor")]
        rows.append((key, metrics.ARROWS[key], *cells, *ends))
    for key in ("calls", "head_calls", "first_frame_ms", "ms_per_latent", "parameters", "guidance_scale"):
        rows.append((key, "", *(f"{one[key]:,}" for one in systems), "", ""))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(f"{cell:{'<' if k < 2 else '>'}{widths[k]}}" for k, cell in enumerate(r)) for r in rows)
