"""The protocols: the truth scores as the truth, wrong answers fall to chance, and results keep their contract."""

import io
import json
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import minicmdm
from minicmdm import cli
from minicmdm.data.dataset import toy_dataset
from minicmdm.evaluation import evaluators, metrics, protocols
from minicmdm.motion import Motion
from minicmdm.pipeline import MotionPipeline

KEYS = "oracle_accuracy oracle_accuracy_heldout r_at_1 r_at_2 r_at_3 mm_dist fid diversity multimodality clip_score"
KEYS = {*KEYS.split(), "skating_ratio"}
RECON = {"mpjpe_mm", "pa_mpjpe_mm", "accel_mm", "recon_fid", "recon_oracle_accuracy"}
LIMIT = 64


@pytest.fixture(scope="module")
def clips():
    return toy_dataset("test", LIMIT).clips


class Judge:
    """Motions as a random projection of their mean frame; a sentence stands where the motion it was told of stands."""

    def __init__(self, clips):
        self.cfg, self.mean = SimpleNamespace(embed_dim=8), torch.zeros(1)
        self.turn = torch.randn(263, 8, generator=torch.Generator().manual_seed(0))
        self.told = {caption: clip.features for clip in clips for caption in clip.captions}

    def motion(self, x, lengths):
        return torch.stack([one[:n].mean(0) @ self.turn for one, n in zip(x, lengths.tolist())])

    def sentences(self, sentences):
        features = [torch.from_numpy(self.told[sentence]) for sentence in sentences]
        return torch.stack([one.mean(0) @ self.turn for one in features])


class Pipe:
    """Answers a caption with the true motion of the clip that is `step` places further on, and keeps what it heard."""

    def __init__(self, clips, step=0):
        self.clips, self.step, self.heard = clips, step, []
        self.place = {caption: i for i, clip in enumerate(clips) for caption in clip.captions}

    def __call__(self, prompts, frames, *, seed, **ask):
        motions = []
        for prompt, count, luck in zip(prompts, frames, seed):
            features = np.zeros((4, 263), np.float32)
            if prompt in self.place:
                self.heard.append((prompt, count, luck, ask))
                features = self.clips[(self.place[prompt] + self.step) % len(self.clips)].features
            motions.append(Motion(np.zeros((4, 22, 3)), features, prompt))  # the protocol makes its own joints
        return motions

    def reconstruct(self, features):
        return features[:-3].copy()


@pytest.fixture(scope="module")
def bench(clips):
    return dict.fromkeys(evaluators.BENCH, Judge(clips))


def run(pipe, bench, **options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocols, "TEXTS", 6)
        patch.setattr(protocols, "SAMPLES", 3)
        return protocols.text_to_motion(pipe, bench, limit=LIMIT, progress=False, **{"repeats": 2, **options})


@pytest.fixture(scope="module")
def true_pipe(clips):
    return Pipe(clips)


@pytest.fixture(scope="module")
def true(true_pipe, bench):
    return run(true_pipe, bench, schedule="full", num_steps=7, uncertainty=3, guidance_scale=2.0)


@pytest.fixture(scope="module")
def other(clips, bench):
    return run(Pipe(clips, step=9), bench)


def test_the_truth_scores_as_the_truth(true):
    for key, entry in {**true["metrics"], **true["fields"]}.items():
        if key != "multimodality":
            assert entry["mean"] == pytest.approx(entry["gt"], abs=1e-9), key
    assert true["metrics"]["oracle_accuracy"]["mean"] > 0.95
    assert true["metrics"]["fid"]["mean"] < 1e-9 < true["metrics"]["fid"]["floor"]
    assert true["metrics"]["r_at_1"]["mean"] == 1 and true["metrics"]["mm_dist"]["mean"] < 1e-6
    assert true["metrics"]["clip_score"]["mean"] == pytest.approx(1, abs=1e-6)
    assert true["metrics"]["multimodality"]["mean"] < 1e-6  # it has one answer to a text


def test_another_clip_s_motion_falls_to_chance(other):
    numbers = {key: entry["mean"] for key, entry in other["metrics"].items()}
    for k in (1, 2, 3):
        assert numbers[f"r_at_{k}"] < k / protocols.POOL + 0.12  # standard error of 2 x 64 texts: 0.025 at k = 3
    assert numbers["oracle_accuracy"] < 0.25 and numbers["oracle_accuracy_heldout"] < 0.25
    assert numbers["fid"] < 1e-9  # the set of motions is the true one: FID cannot see who answered what
    assert numbers["mm_dist"] > 1 and numbers["clip_score"] < 0.99
    assert max(entry["mean"] for entry in other["fields"].values()) < 0.8


def test_heldout_are_the_clips_with_new_pairs(clips, bench):
    class Half(Pipe):
        """Right where the pair of actions is new, and wrong everywhere else."""

        def __call__(self, prompts, frames, *, seed, **ask):
            wrong = super().__call__(prompts, frames, seed=seed, **ask)
            right = Pipe(clips)(prompts, frames, seed=seed, **ask)
            new = [prompt in self.place and clips[self.place[prompt]].kind == "pairs" for prompt in prompts]
            return [b if is_new else a for a, b, is_new in zip(wrong, right, new)]

    numbers = run(Half(clips, step=9), bench, repeats=1)["metrics"]
    assert numbers["oracle_accuracy_heldout"]["mean"] == numbers["oracle_accuracy_heldout"]["gt"] > 0.9
    assert numbers["oracle_accuracy"]["mean"] < 0.6


def test_ground_truth_and_floor_know_nothing_of_the_pipeline(true, other):
    for key in KEYS:
        for row in ("gt", "floor"):
            assert true["metrics"][key][row] == other["metrics"][key][row], (key, row)


def test_the_floor_is_another_motion_of_the_same_program(true, clips):
    floor = {key: entry["floor"] for key, entry in true["metrics"].items()}
    assert floor["oracle_accuracy"] > 0.95 and floor["oracle_accuracy_heldout"] > 0.9
    assert floor["fid"] > 0 and floor["multimodality"] > 0 and 0 < floor["mm_dist"]
    fresh, again = (protocols._afresh(clips[5], number).features for number in (5, 6))
    assert len({len(clips[5].features), len(fresh), len(again)}) > 1
    n = min(len(fresh), len(again), len(clips[5].features))
    assert not np.allclose(fresh[:n], clips[5].features[:n]) and not np.allclose(fresh[:n], again[:n])
    assert np.array_equal(fresh, protocols._afresh(clips[5], 5).features)


def test_contract(true):
    assert set(true["metrics"]) == KEYS and KEYS <= set(metrics.ARROWS)
    assert all(set(entry) == {"mean", "ci95", "gt", "floor"} for entry in true["metrics"].values())
    assert [key for key, entry in true["metrics"].items() if None in entry.values()] == ["multimodality"]
    assert true["metrics"]["multimodality"]["gt"] is None
    assert set(true["fields"]) == {"action", "side", "direction", "speed", "count", "overlay"}
    said = {key: true[key] for key in ("protocol", "repeats", "schedule", "num_steps", "uncertainty", "guidance_scale")}
    assert list(said.values()) == ["t2m", 2, "full", 7, 3, 2.0] and true["clips"] == LIMIT
    assert true["evaluator"] == "t2m_essential" and len(true["fingerprint"]) == 16
    assert json.loads(json.dumps(true, allow_nan=False)) == true


def test_what_the_pipeline_is_asked(true, true_pipe, clips):
    """Each clip once a repeat, at its own length, with captions and seeds that change; then 6 texts 3 times each."""
    first, second = true_pipe.heard[:LIMIT], true_pipe.heard[LIMIT + 18 :]
    spread = true_pipe.heard[LIMIT : LIMIT + 18]
    assert len(second) == LIMIT and {tuple(ask.items()) for *_, ask in true_pipe.heard} == {
        (("schedule", "full"), ("num_steps", 7), ("uncertainty", 3), ("guidance_scale", 2.0))
    }
    for heard in (first, second):
        assert sorted(true_pipe.place[prompt] for prompt, *_ in heard) == list(range(LIMIT))
        assert len({luck for _, _, luck, _ in heard}) == LIMIT
    assert all(count == len(clips[true_pipe.place[prompt]].features) for prompt, count, *_ in true_pipe.heard)
    assert 10 < sum(a[0] not in {b[0] for b in second} for a in first) < LIMIT
    assert not {luck for _, _, luck, _ in first} & {luck for _, _, luck, _ in second}
    prompts = [prompt for prompt, *_ in spread]
    assert len(set(prompts)) == 6 and {prompts.count(prompt) for prompt in prompts} == {3}
    assert len({luck for _, _, luck, _ in spread}) == 18 and set(prompts) <= {prompt for prompt, *_ in first}


def test_the_same_run_gives_the_same_numbers(other, clips, bench):
    assert run(Pipe(clips, step=9), bench) == other
    short = run(Pipe(clips, step=9), bench, repeats=1)["metrics"]
    assert short["r_at_1"]["ci95"] == 0 and short["multimodality"] == other["metrics"]["multimodality"]


def test_real_judges_read_each_motion_as_if_it_were_alone(clips):
    """An untrained bench: what stands in a batch must not change a motion's place, and pools of 32 must be met."""
    words = sorted({word for clip in clips for caption in clip.captions for word in caption.split()})
    torch.manual_seed(0)
    bench = {
        name: evaluators.Evaluator(replace(shape, width=16, embed_dim=8), words).eval()
        for name, shape in evaluators.BENCH.items()
    }
    pipe = Pipe(clips)
    wide, narrow = (run(pipe, bench, evaluator=name, repeats=1)["metrics"] for name in ("t2m", "t2m_essential"))
    for numbers in (wide, narrow):
        assert numbers["fid"]["mean"] < 1e-6 and numbers["r_at_1"]["mean"] == numbers["r_at_1"]["gt"] < 0.4
    assert wide["mm_dist"] != narrow["mm_dist"] and wide["clip_score"] == narrow["clip_score"]


def test_reconstruction_of_the_truth_and_of_a_moved_joint(clips, bench):
    perfect = protocols.reconstruction(Pipe(clips), bench, limit=32, progress=False)
    assert set(perfect["metrics"]) == RECON and perfect["repeats"] == 1 and perfect["schedule"] is None
    for key, entry in perfect["metrics"].items():
        assert entry["mean"] == pytest.approx(entry["gt"], abs=1e-6) and entry["ci95"] == 0, key
        assert entry["floor"] is None
    assert perfect["metrics"]["recon_oracle_accuracy"]["gt"] > 0.9

    class Moved(Pipe):
        def reconstruct(self, features):
            moved = features.copy()
            moved[1::2, 4 + 3 * 14 + 1] += 0.022  # joint 15, the head, 22 mm up in every other frame
            return moved

    moved = protocols.reconstruction(Moved(clips), bench, limit=32, progress=False)["metrics"]
    assert moved["mpjpe_mm"]["mean"] == pytest.approx(0.5, rel=1e-3)  # 22 mm / 22 joints / 2
    assert moved["accel_mm"]["mean"] == pytest.approx(2.0, rel=1e-3)  # 0, 22, 0: second difference 44 mm / 22 joints
    assert 0 < moved["pa_mpjpe_mm"]["mean"] < 2 and moved["recon_fid"]["mean"] > 0


def test_evaluate_merges_what_was_asked(true, clips, bench, monkeypatch):
    monkeypatch.setattr(protocols, "TEXTS", 2)
    monkeypatch.setattr(protocols, "SAMPLES", 2)
    common = dict(limit=32, progress=False, checkpoint="mine", repeats=1)
    pipe = Pipe(clips)
    both = minicmdm.evaluate(pipe, bench, schedule="full", **common)
    assert set(both["metrics"]) == KEYS | RECON and set(both["fields"]) == set(true["fields"])
    assert [both[key] for key in ("protocol", "repeats", "schedule", "checkpoint")] == ["t2m+recon", 1, "full", "mine"]
    one = minicmdm.evaluate(pipe, bench, "recon", **common)
    assert set(one["metrics"]) == RECON and one["protocol"] == "recon" and one["checkpoint"] == "mine"
    assert set(minicmdm.evaluate(pipe, bench, "t2m", **common)["metrics"]) == KEYS
    with pytest.raises(ValueError, match="schedule has no meaning"):
        minicmdm.evaluate(pipe, bench, "recon", schedule="full", **common)
    check_table(protocols.table(both), both)


def check_table(text, result):
    """One row a metric and a field, columns aligned, every number where it belongs."""
    title, blank, header, *rows = text.splitlines()
    assert blank == "" and header.split() == ["model", "GT", "floor"] and "protocol t2m+recon" in title
    assert len({len(line) for line in (header, *rows)}) == 1
    entries = [*result["metrics"].items(), *((f"fields.{key}", entry) for key, entry in result["fields"].items())]
    for (key, entry), row in zip(entries, rows, strict=True):
        name, arrow, *numbers = row.replace("±", " ").split()
        wanted = ["-" if entry[k] is None else f"{entry[k]:.4f}" for k in ("mean", "ci95", "gt", "floor")]
        assert name == key and numbers == wanted
        assert arrow == {"r_at_1": "↑", "fid": "↓", "recon_fid": "↓", "diversity": "→", "fields.side": "↑"}.get(
            key, arrow
        )


def test_bad_requests_come_before_the_work(clips, bench, monkeypatch):
    monkeypatch.setattr(protocols, "toy_dataset", lambda *_: pytest.fail("worked"))
    bad = {
        "protocol": {"protocol": "t2v"},
        "evaluator": {"evaluator": "clip_essential"},
        "repeats": {"repeats": 0},
        "at least 32": {"limit": 31},
    }
    for message, options in bad.items():
        with pytest.raises(ValueError, match=message):
            protocols.evaluate(Pipe(clips), bench, **options)

    def refuse(prompts, frames, *, seed, **ask):
        raise ValueError("no such schedule")

    with pytest.raises(ValueError, match="no such schedule"):
        protocols.text_to_motion(refuse, bench)


def test_a_pipeline_takes_what_the_protocols_ask(tiny_pipe):
    with pytest.raises(ValueError, match="zigzag"):
        protocols.text_to_motion(tiny_pipe, {}, schedule="zigzag", progress=False)
    motion = tiny_pipe(("a person stands",), (8,), seed=[3], schedule="full", num_steps=2)[0]
    assert motion.features.shape == (8, 263) and len(tiny_pipe.reconstruct(motion.features)) == 8


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def command(true, tmp_path, monkeypatch):
    """`minicmdm evaluate` in an empty folder, with a result that waits; returns what `evaluate` was given."""
    given = {}

    def fake(pipe, progress, **options):
        given.update(options)
        return {**true, "protocol": "t2m+recon"}

    monkeypatch.setattr(protocols, "evaluate", fake)
    monkeypatch.setattr(MotionPipeline, "from_pretrained", lambda name: name)
    monkeypatch.chdir(tmp_path)
    return lambda *more: given if cli.main(["evaluate", "--checkpoint", "mine", *more]) == 0 else None


def test_the_command_passes_on_only_what_was_given(command):
    assert command() == {"checkpoint": "mine", "limit": None}
    flags = "--protocol t2m --schedule full --steps 9 --uncertainty 1 --guidance 1.5 --repeats 2 --limit 40"
    given = command(*flags.split(), "--evaluator", "t2m")
    wanted = dict(protocol="t2m", schedule="full", num_steps=9, uncertainty=1, guidance_scale=1.5, repeats=2, limit=40)
    assert given == {**wanted, "evaluator": "t2m", "checkpoint": "mine"}


def test_the_command_prints_a_table_or_json_and_writes(command, true, tmp_path, capsys):
    assert command("--json", "--out", "table.txt") is not None
    out, err = capsys.readouterr()
    assert json.loads(out)["metrics"] == true["metrics"] and out.count("\n") == 1 and err.count("wrote") == 1
    assert command("--out", "numbers.json") is not None
    out, _ = capsys.readouterr()
    assert out == (tmp_path / "table.txt").read_text("utf-8")
    check_table(out.rstrip("\n"), true)
    assert json.loads((tmp_path / "numbers.json").read_text("utf-8"))["fields"] == true["fields"]
    assert command("--out", "numbers.json") is None and command("--out", "numbers.json", "--force") is not None
    assert sorted(path.name for path in tmp_path.iterdir()) == ["numbers.json", "table.txt"]


def test_a_terminal_without_arrows_still_shows_the_table(command, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert command("--table") is not None
    stream.flush()
    lines = stream.buffer.getvalue().decode("ascii").splitlines()
    assert len({len(line) for line in lines[2:]}) == 1 and "oracle_accuracy" in lines[3]


def test_the_quick_protocol_takes_the_same_sampling(monkeypatch, tmp_path, capsys):
    from minicmdm.evaluation import quick

    monkeypatch.setattr(quick, "evaluate_quick", lambda pipe, progress, limit, **sampling: {**sampling, "n": limit})
    monkeypatch.setattr(MotionPipeline, "from_pretrained", lambda name: name)
    monkeypatch.chdir(tmp_path)
    base = ["evaluate", "--quick", "--limit", "3"]
    assert cli.main([*base, "--json", "--steps", "5", "--out", "quick.json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"num_steps": 5, "n": 3}
    assert json.loads((tmp_path / "quick.json").read_text("utf-8")) == {"num_steps": 5, "n": 3}
    assert cli.main(base) == 0
    assert re.fullmatch(r"n +3\n", capsys.readouterr().out)


def test_help_names_every_stage(capsys):
    from minicmdm.training.stages import STAGES

    cli.main(["train", "--help"])
    said = capsys.readouterr().out
    assert all(re.search(rf"\b{name}\b", said) for name in STAGES)
