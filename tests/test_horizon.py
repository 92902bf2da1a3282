"""Long motions: the truth scores as the truth, spoilt seams are heard, and every prompt is told at its own frame."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import make_tiny_preset
from model_helpers import randomise

import minicmdm
from minicmdm import cli
from minicmdm.data import synthesis
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import turn
from minicmdm.data.programs import Segment, may_follow
from minicmdm.evaluation import horizon, metrics, protocols
from minicmdm.evaluation.evaluators import load_bench
from minicmdm.evaluation.horizon import Take
from minicmdm.live import follow
from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import TextEncoder
from minicmdm.models.vae import MACVAE
from minicmdm.pipeline import MotionPipeline
from minicmdm.training.checkpoints import Checkpoint

KEYS = "oracle_accuracy r_at_1 r_at_2 r_at_3 mm_dist fid diversity pj auj transition_fid transition_distance_cm m2t m2m"
KEYS = {*KEYS.split(), "segments_found"}
SIZES = {"long": (4, 8), "mtt": (11, 3)}
LIMIT = 80


class Pipe:
    """Answers with the truth, `spoil` (joints, spans -> joints) by name; streams keep what they are told, and when."""

    def __init__(self, spoil=lambda joints, spans: joints):
        self.spoil, self.acted, self.streams = spoil, [], []

    def act_out(self, prompts, rng, act_out=horizon.act_out):
        self.acted.append(act_out(prompts, rng))
        return self.acted[-1]

    def stream(self, prompts, *, num_frames, seed=None, **ask):
        if seed is not None:
            half = len(self.acted) // 2  # one repeat: first the truth, then another performer for the floor
            done = sum(len(stream.takes) for stream in self.streams)
            takes = self.acted[:half][done : done + len(prompts)]
            assert [take.prompts[0][1] for take in takes] == prompts
            self.streams.append(Stream(takes, num_frames, self.spoil, seed, ask))
            return self.streams[-1]


class Stream:
    horizon = 40

    def __init__(self, takes, num_frames, spoil, seed, ask):
        self.takes, self.seed, self.ask, self.frame, self.told = takes, seed, ask, 0, []
        self.joints = [spoil(take.joints.copy(), take.spans) for take in takes]
        self.joints = [np.concatenate([j, np.zeros((num_frames - len(j), 22, 3))]) for j in self.joints]

    def prompt(self, prompts, at, lasts):
        assert max(0, at - self.horizon) < self.frame + 1 and at >= self.frame  # neither too soon nor too late
        (k,) = [k for k, prompt in enumerate(prompts) if prompt is not None]
        self.told.append((k, at, lasts, prompts[k]))

    def __next__(self):
        self.frame += 1
        return np.stack([joints[self.frame - 1] for joints in self.joints]).astype(np.float32)


@pytest.fixture(scope="module")
def bench():
    return load_bench()


def run(pipe, bench, protocol="long", **options):
    count, each = SIZES[protocol]
    common = dict(compositions=count, prompts_each=each, repeats=1, limit=LIMIT, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(horizon, "act_out", pipe.act_out)
        patch.setattr(horizon, "TOGETHER", 3)
        return protocols.evaluate(pipe, bench, protocol, **{**common, **options})


@pytest.fixture(scope="module", params=["long", "mtt"])
def true(request, bench):
    pipe = Pipe()
    return pipe, run(pipe, bench, request.param, schedule="autoregressive", num_steps=7, checkpoint="mine")


def test_the_truth_scores_as_the_truth(true):
    numbers = true[1]["metrics"]
    for key, entry in {**numbers, **true[1]["fields"]}.items():
        assert entry["mean"] == pytest.approx(entry["gt"], rel=1e-4, abs=1e-5) and entry["ci95"] == 0, key
    assert numbers["oracle_accuracy"]["mean"] > 0.85 and numbers["r_at_3"]["mean"] > 0.7
    assert numbers["m2m"]["gt"] == pytest.approx(1) and numbers["fid"]["gt"] < 1e-6 > numbers["transition_fid"]["gt"]
    assert 0 < numbers["auj"]["gt"] < 27 * true[1]["calm_jerk"] / 3  # true seams are nearly as calm as the rest
    assert numbers["fid"]["floor"] > 0.01 and numbers["transition_fid"]["floor"] > 0.01
    assert 0.9 < numbers["m2m"]["floor"] < 0.999 and numbers["pj"]["floor"] != numbers["pj"]["gt"]


def test_contract(true):
    _, result = true
    name, (count, each) = result["protocol"], SIZES[result["protocol"]]
    assert set(result["metrics"]) == KEYS <= set(metrics.ARROWS)
    assert all(set(entry) == {"mean", "ci95", "gt", "floor"} for entry in result["metrics"].values())
    assert all(None not in entry.values() for entry in result["metrics"].values())
    said = [result[key] for key in ("compositions", "prompts_each", "repeats", "schedule", "num_steps", "checkpoint")]
    assert said == [count, each, 1, "autoregressive", 7, "mine"] and len(result["fingerprint"]) == 16
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    title, _, header, *rows = protocols.table(result).splitlines()
    assert f"protocol {name}" in title and header.split() == ["model", "GT", "floor"]
    assert len(rows) == len(KEYS) + len(result["fields"]) and len({len(row) for row in rows}) == 1


def test_every_prompt_is_told_at_its_frame_and_for_its_time(true):
    pipe, result = true
    takes = [take for stream in pipe.streams for take in stream.takes]
    assert takes == pipe.acted[: result["compositions"]] and max(len(stream.takes) for stream in pipe.streams) == 3
    for stream in pipe.streams:
        told = [
            (k, a, b - a, said) for k, t in enumerate(stream.takes) for (a, b), (_, said) in zip(t.spans, t.prompts)
        ]
        assert sorted(stream.told) == sorted(told)
        assert stream.ask == dict(schedule="autoregressive", num_steps=7, uncertainty=2, guidance_scale=3.0)
        assert stream.frame == max(len(take.joints) for take in stream.takes)
    assert len({luck for stream in pipe.streams for luck in stream.seed}) == len(takes)


def test_what_is_asked_comes_from_the_test_set(true):
    pipe, result = true
    known = {
        (s, label[2]) for i in range(LIMIT) for c in [make_clip("test", i)] for s, label in zip(c.program, c.labels)
    }
    prompts = [prompt for take in pipe.acted[: result["compositions"]] for prompt in take.prompts]
    assert set(prompts) <= known and len(prompts) == result["compositions"] * result["prompts_each"]
    if result["protocol"] == "long":
        assert len({segment for segment, _ in prompts[: protocols.POOL]}) == protocols.POOL
    for take in pipe.acted:
        names = [segment.action for segment, _ in take.prompts]
        assert all(may_follow(*pair) for pair in zip(names, names[1:]))


# --- spoilt motions ---------------------------------------------------------------------------------------------------


def moved(joints, spans):
    """At every second seam the whole body is somewhere else, 30 cm away; until the next."""
    for a, b in spans[1::2]:
        joints[a:b, :, 0] += 0.3
    return joints


def raised(joints, spans):
    """The pose jumps: at every second seam the arms are 20 cm higher, and at the next they are back."""
    for a, b in spans[1::2]:
        joints[a:b, 18:22, 1] += 0.2
    return joints


def hesitating(joints, spans):
    """Each new prompt finds the body frozen for half a second, and then it catches up at once."""
    for a, _ in spans[1:]:
        joints[a : a + 10] = joints[a]
    return joints


def frozen(joints, spans):
    return np.repeat(joints[:1], len(joints), axis=0)


def test_spoilt_seams_are_heard(bench):
    pipes = {spoil.__name__: run(Pipe(spoil), bench)["metrics"] for spoil in (moved, raised, hesitating)}
    for name, numbers in pipes.items():
        for key in ("pj", "auj", "transition_fid"):
            assert numbers[key]["mean"] > 1.5 * numbers[key]["gt"] + 0.02, (name, key)
    jump = {name: numbers["transition_distance_cm"] for name, numbers in pipes.items()}
    assert jump["moved"]["mean"] == pytest.approx(jump["moved"]["gt"], rel=0.01)  # seen from the pelvis, no jump
    assert jump["raised"]["mean"] > jump["raised"]["gt"] + 2  # 20 cm of 4 of the 22 joints
    assert jump["hesitating"]["mean"] == pytest.approx(
        jump["hesitating"]["gt"], rel=0.01
    )  # the jump comes ten frames late


def test_a_frozen_body_has_no_jerk_and_pays_for_it(bench):
    result = run(Pipe(frozen), bench)
    numbers = {key: entry["mean"] for key, entry in result["metrics"].items()}
    assert numbers["pj"] < 1e-5 and numbers["transition_distance_cm"] < 1e-3
    assert numbers["auj"] == pytest.approx(27 * result["calm_jerk"], rel=1e-4)  # all that is under the reference
    assert numbers["oracle_accuracy"] < 0.2 and numbers["r_at_1"] < 0.3 and numbers["m2m"] < 0.95
    assert result["metrics"]["segments_found"]["mean"] < 0.3


# --- the parts --------------------------------------------------------------------------------------------------------


def take(frames, starts, shift=0.1):
    """A standing body that is moved up at each start, and the spans between the starts."""
    joints = make_clip("test", 0).features  # any body
    joints = np.repeat(minicmdm.features_to_joints(joints.astype(np.float64))[:1], frames + 1, axis=0)
    for start in starts:
        joints[start:, :, 1] += shift
    cuts = [0, *starts, frames]
    return Take([(Segment("stand"), "a person stands")] * (len(starts) + 1), joints, list(zip(cuts, cuts[1:])))


def test_windows_are_centred_on_seams():
    one = take(120, [40, 77])
    assert one.seams == [40, 77]
    windows = horizon._stood(one.around(one.seams))
    assert windows.shape == (2, 30, 22, 3) and np.allclose(windows[:, 0, 0, [0, 2]], 0)
    curve = metrics.jerk_curve(windows)
    assert (
        curve.argmax() == 13
        and np.allclose(curve[12:15], [0.1, 0.2, 0.1])
        and np.allclose(np.delete(curve, [12, 13, 14]), 0)
    )
    assert metrics.area_under_jerk(windows, 0.05) == pytest.approx(0.05 + 0.15 + 0.05 + 24 * 0.05)
    assert np.array_equal(one.around([40])[0], one.joints[25:56])  # the 31st is for features
    turned = replace(one, joints=turn(one.joints, np.full(121, 1.0)) + [3.0, 0.0, 4.0])
    assert np.allclose(horizon._stood(turned.around(one.seams)), windows)


def test_the_reference_is_the_jerk_between_seams():
    one = take(120, [40, 77, 100])
    assert horizon.calm([one]) == pytest.approx(0, abs=1e-12)  # 20, 58; the short ones have no room for a window
    one.joints[70:, :, 1] += 0.27  # in the window of 58, 43 to 72, and of no other
    assert horizon.calm([one]) == pytest.approx((0.27 + 0.54 + 0.27) / 2 / 27)
    one.joints[88:, :, 1] += 5
    assert horizon.calm([one]) == pytest.approx((0.27 + 0.54 + 0.27) / 2 / 27)


def test_pieces_are_clips_of_their_own(monkeypatch):
    segments = [(Segment(name), "") for name in ("walk", "turn", "sit")]
    one = horizon.act_out(segments, np.random.default_rng(1))
    given = []
    monkeypatch.setattr(horizon, "embed", lambda judge, says, pieces: (None, given.append((judge, pieces))))
    horizon._see(["first", "second"], [one])
    (_, segments), (_, again), (judge, windows) = given
    assert [judge for judge, _ in given] == ["first", "second", "first"] and len(again) == len(segments)
    assert [len(piece) for piece in segments] == [b - a for a, b in one.spans]
    assert len(windows) == len(one.seams) and {piece.shape for piece in windows} == {(30, 263)}
    for piece, (a, b) in zip(segments, one.spans):  # it stands at the origin, facing +Z, and is otherwise the same
        assert np.allclose(minicmdm.features_to_joints(piece), minicmdm.canonicalize(one.joints[a:b]), atol=1e-5)


def test_each_judge_has_its_numbers(bench):
    usual = run(Pipe(), bench)["metrics"]
    others = run(Pipe(), bench, evaluator="t2m"), run(Pipe(), {**bench, "clip_essential": bench["t2m"]})
    wide, swapped = ({key for key in KEYS if usual[key]["floor"] != other["metrics"][key]["floor"]} for other in others)
    assert {"mm_dist", "fid", "diversity", "transition_fid"} <= wide and swapped == {"m2t", "m2m"}
    assert not wide & {"m2t", "m2m", "pj", "auj", "transition_distance_cm", "oracle_accuracy", "segments_found"}


def test_an_answer_belongs_to_the_prompt_in_whose_time_it_falls(monkeypatch):
    walk, bow, jump, turn = (Segment(name) for name in ("walk", "bow", "jump", "turn"))
    one = take(120, [40, 80])
    found = [(turn, 0, 4), (walk, 4, 44), (bow, 39, 62), (jump, 70, 90)]  # the jump's middle, 80, is the third's first
    monkeypatch.setattr(horizon, "read_motion", lambda joints: [replace(s, start=a, end=b) for s, a, b in found])
    names = [[segment.action for segment in answer] for answer in horizon.answers(one)]
    assert names == [["turn", "walk"], ["bow"], ["jump"]]
    assert metrics.segment_accuracy([(walk,), (bow,), (jump,)], horizon.answers(one)) == 2 / 4


def test_a_performer_acts_out_what_no_clip_has_room_for():
    clip = make_clip("test", 2)
    prompts = [(segment, "") for segment in clip.program]
    short, same = (
        horizon.act_out(prompts, np.random.default_rng(1)),
        synthesis.synthesise(clip.program, np.random.default_rng(1)),
    )
    assert np.array_equal(short.joints, same.joints)
    assert short.spans[0][0] == 0 and short.spans[-1][1] == len(short.joints) - 1
    assert short.seams == [segment.start for segment in same.program[1:]]
    segments = [(Segment(name), "") for name in ("walk", "jump", "sit", "run", "wave", "bow", "march", "clap")]
    segments = [(replace(s, count=2) if s.action in ("jump", "bow") else s, "") for s, _ in segments]
    long = horizon.act_out(segments, np.random.default_rng(0))
    assert len(long.joints) > 300 and synthesis.MAX_FRAMES == 196
    assert [found.action for found in minicmdm.read_motion(long.joints)] == [segment.action for segment, _ in segments]
    with pytest.raises(KeyError):
        horizon.act_out([(Segment("fly"), "")], np.random.default_rng(0))
    assert synthesis.MAX_FRAMES == 196


def test_a_poor_source_is_refused():
    source = [(Segment("walk"), "a"), (Segment("walk"), "b"), (Segment("run"), "c")]
    drawn = horizon.draw(source, 5, 2, 2, np.random.default_rng(0))
    assert len(drawn) == 5 and all({s.action for s, _ in pair} == {"walk", "run"} for pair in drawn)
    with pytest.raises(ValueError, match="3 prompts are too much alike to choose 3 different ones: take more clips"):
        horizon.draw(source, 1, 3, 3, np.random.default_rng(0))


def test_a_segment_looks_for_its_text_among_all():
    places = np.eye(4)
    judge = SimpleNamespace(sentences=lambda said: torch.tensor(places[[int(one) for one in said]]))
    texts = [(Segment("jump", count=k), str(k)) for k in range(4)]

    def hits(motions, asked):
        seen = SimpleNamespace(motions=[np.array(motions)], asked=[(texts[k][0],) for k in asked])
        return horizon.r_precision(judge, seen, texts).tolist()

    assert hits(places[[2, 0, 0]], [2, 0, 0]) == [1, 1, 1]
    near = np.array([0.5, 1.0, 0.7, 0.0])  # 1, then 2, then 0, then 3
    assert hits([near, near], [0, 2]) == [0, 0.5, 1]
    assert hits(np.zeros((2, 4)), [0, 3]) == [0.25, 0.5, 0.75]  # equals share: chance


@pytest.fixture(scope="module")
def loud_pipe():
    """A whole system that was never trained, with no weight at zero: it hears every word."""
    plan = make_tiny_preset()
    text = TextEncoder.from_captions(["a person walks, runs, jumps and sits down"], plan.text)
    sizes = {"feature": 263, "latent": plan.dit.latent_dim}
    stats = {f"{name}_{key}": torch.full((n,), 0.3) for name, n in sizes.items() for key in ("mean", "std")}
    vae, dit = (randomise(module).float() for module in (MACVAE(plan.vae), CausalDiT(plan.dit)))
    return MotionPipeline(Checkpoint(plan, vae, dit, text, stats, {}))


def test_streams_in_step_are_streams_alone(loud_pipe):
    """What the protocol makes of a batch is what `live.follow` makes of each timeline by itself."""
    ask = dict(schedule="fss", num_steps=4, uncertainty=2, guidance_scale=2.0)
    says = [("a person walks", "a person runs", "a person sits down"), ("a person jumps", "a person walks")]
    spans = [[(0, 21), (21, 40), (40, 61)], [(0, 30), (30, 50)]]
    takes = [
        Take([(Segment("stand"), said) for said in some], np.zeros((parts[-1][1] + 1, 22, 3)), parts)
        for some, parts in zip(says, spans)
    ]
    made = horizon.follow_all(loud_pipe, takes, [3, 4], ask, None)
    for one, some, seed in zip(made, says, (3, 4)):
        lines = [(b - a, said) for (a, b), said in zip(one.spans, some)]
        stream = loud_pipe.stream(some[0], lasts=lines[0][0], seed=seed, **ask)
        alone = np.stack([frame for _, frame in follow(stream, lines[0], iter(lines[1:]))])
        assert len(one.joints) == len(alone) + 1 and np.allclose(one.joints[:-1], alone, atol=1e-4)
    deaf = horizon.follow_all(loud_pipe, [replace(takes[0], prompts=takes[0].prompts[:1] * 3)], [3], ask, None)[0]
    change = np.abs(deaf.joints - made[0].joints).max((1, 2))
    assert change[:20].max() < 1e-4 < 1e-2 < change[20:].max()  # 21 is nearest to the latent that begins at 20


# --- what is refused, and the command ---------------------------------------------------------------------------------


def test_bad_requests_come_before_the_work(bench, loud_pipe, monkeypatch):
    monkeypatch.setattr(horizon, "toy_dataset", lambda *_: pytest.fail("worked"))
    bad = {
        "unknown protocol 'short': expected t2m or recon, long or mtt": {"protocol": "short"},
        "at least 2 prompts, and 32 prompts in all.* and 3 of 8 came": {"compositions": 3},
        "and 64 of 1 came": {"compositions": 64, "prompts_each": 1},
        "and 0 of 8 came": {"compositions": 0},
        "for the protocols long and mtt alone": {"protocol": "t2m", "prompts_each": 4},
        "protocols long and mtt": {"protocol": None, "compositions": 64},
        "at least 32": {"limit": 31},
        "trapezoid": {"schedule": "trapezoid"},
        "num_steps": {"num_steps": 0},
    }
    for message, options in bad.items():
        with pytest.raises(ValueError, match=message):
            protocols.evaluate(loud_pipe, bench, **{"protocol": "long", **options})


@pytest.mark.parametrize("protocol", ["long", "mtt"])
def test_too_few_clips_are_refused(bench, protocol, monkeypatch):
    clip = make_clip("test", 1)
    monkeypatch.setattr(horizon, "toy_dataset", lambda *_: SimpleNamespace(clips=[clip] * 40))
    with pytest.raises(ValueError, match="too much alike to choose .* take more clips"):
        run(Pipe(), bench, protocol)


def test_the_command(monkeypatch, true, tmp_path, capsys):
    given = {}

    def fake(pipe, progress, **options):
        given.update(options)
        return true[1]

    monkeypatch.setattr(protocols, "evaluate", fake)
    monkeypatch.setattr(MotionPipeline, "from_pretrained", lambda name: name)
    monkeypatch.chdir(tmp_path)
    flags = "--protocol mtt --compositions 20 --prompts-each 4 --repeats 2 --json --out out.json"
    assert cli.main(["evaluate", *flags.split()]) == 0
    sizes = {"compositions": 20, "prompts_each": 4, "repeats": 2}
    assert given == {"protocol": "mtt", **sizes, "checkpoint": "toy", "limit": None}
    out, err = capsys.readouterr()
    assert json.loads(out) == json.loads((tmp_path / "out.json").read_text("utf-8")) == true[1] and "wrote" in err
    refused = {
        "and 2 of 8 came": "--protocol long --compositions 2",
        "long and mtt alone": "--compositions 20",
        "leave out --prompts-each": "--quick --prompts-each 5",
        "expected t2m or recon, long or mtt": "--protocol longer",
    }
    for message, flags in refused.items():
        assert cli.main(["evaluate", *flags.split()]) == 2
        out, err = capsys.readouterr()
        assert out == "" and message in err and err.startswith("minicmdm: ") and err.count("\n") == 1
