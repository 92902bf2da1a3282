"""Long motions: prompt after prompt in one stream, judged segment by segment and at the seams between them.

    protocol "long"    FlowMDM's: many prompts in a row; each text looks for its segment among those of 32 texts
    protocol "mtt"     STMC's, its timelines on one track: three prompts out of 60; each segment looks for its text

A prompt is a segment of a test program, in that segment's own sentence. The truth is a performer who does all that a
composition asks: the toy world can act out what HumanML3D never recorded, so that even seams have a ground truth. The
model is told each sentence at the frame where the performer begins to act it. Both motions are cut at these frames, and
each piece becomes features anew, as a clip of its own. What the metrics mean here:

    oracle_accuracy           the answer to a prompt is what the oracle finds with its middle in the prompt's frames
    segments_found            how much it finds for a prompt
    r_at_k mm_dist fid diversity    segments, where the chosen judge places them
    m2t m2m                   segments and their texts, segments and true ones, for the judge that goes by cosine
    pj auj                    jerk around the seams; AUJ's reference is the mean jerk in the middle of true segments
    transition_fid            the same windows, 1.5 s around the seams, where the chosen judge places them
    transition_distance_cm    how far the pose jumps into a segment's first frame
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from tqdm import tqdm

from minicmdm.asking import sampling_of
from minicmdm.data import synthesis
from minicmdm.data.dataset import toy_dataset, world_fingerprint
from minicmdm.data.features import canonicalize, joints_to_features
from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import FIELDS, Program, Segment, may_follow
from minicmdm.evaluation import metrics
from minicmdm.evaluation.evaluators import Evaluator, embed
from minicmdm.evaluation.protocols import HORIZONS, JUDGE, POOL, Bench, _entry, check
from minicmdm.pipeline import MotionPipeline

TEXTS = 60  # of which the timelines of "mtt" are made; a repeat draws them
# Frames around a seam. FlowMDM has 3 s for HumanML3D and 1 s for BABEL; of ours, some segments last 1.1 s alone.
WINDOW = 30
TOGETHER = 16  # streams in step
Prompt = tuple[Segment, str]  # what is asked for, and the sentence that says it


@dataclass(frozen=True)
class Take:
    """A composition acted out, and one frame more: features need a next frame, so each piece is cut one too long."""

    prompts: list[Prompt]
    joints: np.ndarray  # (T+1,22,3)
    spans: list[tuple[int, int]]  # the frames of each prompt, end exclusive, from 0 to T

    @property
    def seams(self) -> list[int]:
        """The frames at which the next prompt begins."""
        return [start for start, _ in self.spans[1:]]

    def around(self, frames: Iterable[int]) -> list[np.ndarray]:
        """The windows (WINDOW+1,22,3) centred on these frames."""
        return [self.joints[k - WINDOW // 2 : k + WINDOW // 2 + 1] for k in frames]


def timelines(
    pipe: MotionPipeline,
    bench: Bench,
    protocol: str = "long",
    *,
    evaluator: str = JUDGE,
    schedule: str | None = None,
    num_steps: int | None = None,
    uncertainty: int | None = None,
    guidance_scale: float = 3.0,
    compositions: int | None = None,
    prompts_each: int | None = None,
    repeats: int = 5,
    limit: int | None = None,
    progress: bool = True,
) -> dict:
    """Let streams act out compositions, drawn anew in each repeat from the first `limit` test clips; see above.

    A model with a clock is told how long each prompt lasts. `floor` is another performer of the same compositions.
    ValueError for what cannot be asked. Source: Barquero et al. 2024 (FlowMDM), Petrovich et al. 2024 (STMC).
    """
    check(protocol, evaluator, repeats, limit, compositions, prompts_each)
    count, each = (own or usual for own, usual in zip((compositions, prompts_each), HORIZONS[protocol]))
    ask = {**sampling_of(pipe, schedule, num_steps, uncertainty), "guidance_scale": guidance_scale}
    pipe.stream(["a person stands"], num_frames=4, **ask)  # what the pipeline refuses, it refuses here
    clips = toy_dataset("test", limit, progress).clips
    source = [(segment, said) for clip in clips for segment, (_, _, said) in zip(clip.program, clip.labels)]
    judges, rows, calms = [bench[evaluator], bench["clip_essential"]], {"model": [], "gt": [], "floor": []}, []
    for repeat in range(repeats):
        rng = np.random.default_rng(repeat)
        texts = draw(source, 1, TEXTS, TEXTS, rng)[0] if protocol == "mtt" else []
        asked = draw(texts or source, count, each, each if texts else POOL, rng)
        truth, again = ([act_out(prompts, rng) for prompts in asked] for _ in range(2))
        seeds, pairs = rng.integers(2**31, size=count).tolist(), int(rng.integers(2**31))
        note = f"acting, {repeat + 1} of {repeats}" if progress else None
        takes = {"gt": truth, "floor": again, "model": follow_all(pipe, truth, seeds, ask, note)}
        calms.append(calm(truth))
        seen = {name: _see(judges, some) for name, some in takes.items()}
        for name, one in seen.items():
            hits = r_precision(judges[0], one, texts)
            rows[name].append(_score(one, seen["gt"], hits, calms[-1], np.random.default_rng(pairs)))
    summary = {key: _entry(*([row[key] for row in rows[name]] for name in rows)) for key in rows["gt"][0]}
    fields = {key: summary.pop(key) for key in FIELDS if key in summary}
    facts = {"protocol": protocol, "evaluator": evaluator, "compositions": count, "prompts_each": each}
    facts |= {"calm_jerk": float(np.mean(calms)), "fingerprint": world_fingerprint(), "repeats": repeats}
    return {**facts, **ask, "metrics": summary, "fields": fields}


def draw(source: Sequence[Prompt], count: int, each: int, apart: int, rng: Generator) -> list[list[Prompt]]:
    """`count` compositions of `each` prompts, all different in each pool of `apart`. ValueError for a poor source."""
    drawn: list[Prompt] = []
    for _ in range(200 * count * each):
        segment, said = source[rng.integers(len(source))]
        follows = len(drawn) % each == 0 or may_follow(drawn[-1][0].action, segment.action)
        if follows and all(segment != other for other, _ in drawn[len(drawn) // apart * apart :]):
            drawn.append((segment, said))
        if len(drawn) == count * each:
            return [drawn[k : k + each] for k in range(0, len(drawn), each)]
    raise ValueError(f"{len(source)} prompts are too much alike to choose {apart} different ones: take more clips")


def act_out(prompts: list[Prompt], rng: Generator) -> Take:
    """A performer of the toy world does what the prompts ask, in one go, however long it takes."""
    # The limit is lifted here: `synthesis` is part of the world's fingerprint, and the world has not changed.
    usual, synthesis.MAX_FRAMES = synthesis.MAX_FRAMES, 10**9
    try:
        done = synthesis.synthesise(tuple(segment for segment, _ in prompts), rng)
    finally:
        synthesis.MAX_FRAMES = usual
    cuts = [0, *(part.start for part in done.program[1:]), len(done.joints) - 1]
    return Take(prompts, done.joints, list(pairwise(cuts)))


def follow_all(pipe: MotionPipeline, takes: list[Take], seeds: list[int], ask: dict, note: str | None) -> list[Take]:
    """Streams in step are told the prompts of these takes, each at its own frame; `note` names a progress bar."""
    made = []
    for first in range(0, len(takes), TOGETHER):
        some, luck = takes[first : first + TOGETHER], seeds[first : first + TOGETHER]
        length = max(len(take.joints) for take in some)
        stream = pipe.stream([take.prompts[0][1] for take in some], seed=luck, num_frames=length, **ask)
        news = [(a, k, b - a, said) for k, t in enumerate(some) for (a, b), (_, said) in zip(t.spans, t.prompts)]
        news.sort(reverse=True)  # the first of them last
        frames = []
        for number in tqdm(range(length), note, unit="frame", disable=note is None):
            while news and news[-1][0] < number + stream.horizon:  # no sooner: sentences that wait take memory
                start, k, lasts, said = news.pop()
                stream.prompt([said if i == k else None for i in range(len(some))], at=start, lasts=lasts)
            frames.append(next(stream))  # (B,22,3)
        motions = np.stack(frames, axis=1)  # (B,length,22,3)
        made += [replace(take, joints=one[: len(take.joints)]) for take, one in zip(some, motions)]
    return made


@dataclass(frozen=True)
class Seen:
    """What is known of N segments and S seams: where two judges place them, what was done, how joints moved."""

    texts: list[np.ndarray]  # (N,E) each
    motions: list[np.ndarray]  # (N,E) each
    seams: np.ndarray  # (S,E), by the first judge
    windows: np.ndarray  # (S,WINDOW,22,3)
    asked: list[Program]  # N, of one segment each
    found: list[Program]
    jump: float  # cm


def _see(judges: list[Evaluator], takes: list[Take]) -> Seen:
    segments = [_clip(take.joints[a : b + 1]) for take in takes for a, b in take.spans]
    around = [window for take in takes for window in take.around(take.seams)]
    says = [said for take in takes for _, said in take.prompts]
    texts, motions = zip(*[embed(judge, says, segments) for judge in judges])
    _, seams = embed(judges[0], says[:1], [_clip(window) for window in around])
    asked = [(segment,) for take in takes for segment, _ in take.prompts]
    found = [answer for take in takes for answer in answers(take)]
    jump = np.mean([metrics.transition_distance(take.joints, take.seams) for take in takes])
    return Seen(list(texts), list(motions), seams, _stood(around), asked, found, float(jump))


def _clip(joints: np.ndarray) -> np.ndarray:
    """Joints (F+1,22,3) as the features (F,263) of a clip of its own."""
    return joints_to_features(canonicalize(joints)).astype(np.float32)


def _stood(windows: list[np.ndarray]) -> np.ndarray:
    """Windows (W,WINDOW,22,3), each from the origin and facing +Z: jerk hears how a window stands."""
    return np.stack([canonicalize(window[:-1]) for window in windows])


def answers(take: Take) -> list[Program]:
    """What the oracle reads in the whole motion, shared out: to each prompt what has its middle in the prompt's frames.

    Told by its place in the list, as in a single clip, one segment too many would spoil all that follow.
    """
    read = read_motion(take.joints)
    return [tuple(s for s in read if a <= (s.start + s.end) / 2 < b) for a, b in take.spans]


def calm(truth: list[Take]) -> float:
    """AUJ's reference: the mean jerk in the middle of true segments, of those in which a whole window has room."""
    middles = [[(a + b) // 2 for a, b in take.spans if b - a >= WINDOW] for take in truth]
    windows = [window for take, some in zip(truth, middles) for window in take.around(some)]
    return float(metrics.jerk_curve(_stood(windows)).mean())


def r_precision(judge: Evaluator, seen: Seen, texts: list[Prompt]) -> np.ndarray:
    """R@1, R@2, R@3 (3,): of texts in pools of segments or, given a choice of texts, of segments among all of these."""
    if not texts:
        return metrics.r_precision(seen.texts[0], seen.motions[0], POOL)  # pools are cut as they were drawn
    places = judge.sentences([said for _, said in texts]).cpu().double().numpy()  # (TEXTS,E)
    distance = np.linalg.norm(seen.motions[0][:, None] - places, axis=-1)  # (N,TEXTS)
    order = {segment: k for k, (segment, _) in enumerate(texts)}
    own = distance[range(len(distance)), [order[segment] for (segment,) in seen.asked]][:, None]
    closer, level = (distance < own).sum(1), (distance == own).sum(1)  # equals share their places
    return np.array([np.clip((k - closer) / level, 0, 1).mean() for k in (1, 2, 3)])


def _score(seen: Seen, truth: Seen, hits: np.ndarray, reference: float, rng: Generator) -> dict[str, float]:
    """One repeat's numbers for one set of takes: those of `metrics.ARROWS`, and one for each field."""
    return {
        "oracle_accuracy": metrics.segment_accuracy(seen.asked, seen.found),
        "segments_found": sum(map(len, seen.found)) / len(seen.found),
        **dict(zip(("r_at_1", "r_at_2", "r_at_3"), hits)),
        "mm_dist": metrics.mm_distance(seen.texts[0], seen.motions[0]),
        "fid": metrics.frechet_distance(seen.motions[0], truth.motions[0]),
        "diversity": metrics.diversity(seen.motions[0], rng),
        "m2t": metrics.tmr_score(seen.motions[1], seen.texts[1]),
        "m2m": metrics.tmr_score(seen.motions[1], truth.motions[1]),
        "pj": metrics.peak_jerk(seen.windows),
        "auj": metrics.area_under_jerk(seen.windows, reference),
        "transition_fid": metrics.frechet_distance(seen.seams, truth.seams),
        "transition_distance_cm": seen.jump,
        **metrics.field_accuracy(seen.asked, seen.found),
    }
