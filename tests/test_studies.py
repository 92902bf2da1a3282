"""Studies: rows are measured once, intervals are Student's, and what spoils a motion spoils it in the way it says."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch

from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import features_to_joints
from minicmdm.data.oracle import read_motion
from minicmdm.evaluation import drift, reading, small, studies
from minicmdm.evaluation.horizon import act_out, draw
from minicmdm.evaluation.spoilt import Spoilt
from minicmdm.models.text import Words
from minicmdm.motion import Motion


class Truth:
    """A pipeline that knows the answers: each prompt's own synthesised motion."""

    def __init__(self, clips, std):
        self.answers = {clip.captions[0]: clip.features for clip in clips}
        self.stats, self.asked = {"feature_std": torch.from_numpy(std)}, 0

    def __call__(self, prompts, frames, *, seed, **ask):
        self.asked += len(prompts)
        found = [self.answers[prompt] for prompt in prompts]
        return [Motion(features_to_joints(x), x, prompt) for x, prompt in zip(found, prompts)]


@pytest.fixture
def world():
    data = toy_dataset("test", 12)
    clips = {clip.captions[0]: clip for clip in data.clips}
    return list(clips.values()), Truth(clips.values(), data.std)


def ask(pipe, clips):
    return pipe([c.captions[0] for c in clips], [len(c.features) for c in clips], seed=list(range(len(clips))))


def test_what_is_whole_is_the_pipeline_and_is_asked_once(world):
    clips, pipe = world
    for _ in range(2):
        found = ask(Spoilt(pipe, "is whole"), clips)
        assert all(np.array_equal(motion.features, clip.features) for motion, clip in zip(found, clips))
    assert pipe.asked == len(clips)


def test_each_way_of_spoiling_does_what_it_says(world):
    clips, pipe = world
    spoilt = {how: ask(Spoilt(pipe, how, 0.5), clips) for how in ("freezes", "trembles", "is mirrored", "is slow")}
    assert all(np.ptp(m.features, axis=0).max() < 1e-6 for m in spoilt["freezes"])
    for clip, shaken in zip(clips, spoilt["trembles"]):
        apart = (shaken.features - clip.features) / pipe.stats["feature_std"].numpy()
        np.testing.assert_allclose(apart.std(), 0.5, rtol=0.05)
    swap = {"left": "right", "right": "left", None: None}
    sides = [
        (swap[one.side], other.side)
        for clip, m in zip(clips, spoilt["is mirrored"])
        for one, other in zip(read_motion(features_to_joints(clip.features)), read_motion(m.joints))
        if one.action == other.action
    ]
    assert len(sides) > 10 and np.mean([a == b for a, b in sides]) > 0.9
    for clip, slow in zip(clips, spoilt["is slow"]):  # half of the motion, held twice as long
        assert len(slow.features) == len(clip.features)
        np.testing.assert_allclose(
            slow.joints[-1, :, 1], features_to_joints(clip.features)[len(clip.features) // 2, :, 1], atol=0.15
        )


def test_hearing_another_answers_another_prompt(world):
    clips, pipe = world
    found = ask(Spoilt(pipe, "hears another", 1.0), clips)
    assert not any(np.array_equal(motion.features, clip.features) for motion, clip in zip(found, clips))
    assert sorted(len(m.features) for m in found) == sorted(len(c.features) for c in clips)


def test_a_row_is_measured_once(tmp_path, monkeypatch):
    calls = []

    def rows(scratch):
        for k in range(3):
            yield {"model": f"m{k}", "seed": k}, lambda k=k: calls.append(k) or {"score": k / 3}

    monkeypatch.setitem(studies.ROWS, "vae", rows)
    first = studies.run("vae", tmp_path, tmp_path)
    assert calls == [0, 1, 2] and [row["score"] for row in first] == ["0.0", "0.33333", "0.66667"]
    lines = (tmp_path / "vae.csv").read_text().splitlines()
    (tmp_path / "vae.csv").write_text("\n".join(lines[:-1]) + "\n")  # as if stopped before the last
    again = studies.run("vae", tmp_path, tmp_path)
    assert calls == [0, 1, 2, 2] and again == first  # rows of before and of now alike


def test_intervals_and_correlations_against_hand_computed_ones():
    assert studies.interval([1.0, 2.0, 3.0]) == "2 ± 2.5"  # t(0.975, 2) = 4.303 times 1 / sqrt(3)
    assert studies.correlation(np.arange(12.0), np.arange(12.0) ** 3).startswith("+1.00 [+1.00, +1.00], 12")
    assert studies.correlation(np.arange(12.0), -np.exp(np.arange(12.0))).startswith("-1.00")


@pytest.mark.parametrize("name", [name for name in studies.ROWS if studies.read(name)])
def test_committed_rows_can_be_told(name):
    rows = studies.read(name)
    labels = list(rows[0])[: list(rows[0]).index("seed")] if "seed" in rows[0] else list(rows[0])
    told = studies.summary(name, rows).splitlines()
    assert len(told) > len({tuple(row[key] for key in labels) for row in rows})  # a line for the head, and one for each


def test_a_script_fills_its_minutes_with_prompts_of_five_to_ten_seconds():
    takes = drift.scripts(1)
    assert len(takes) == drift.STREAMS and len({take.prompts[0][1] for take in takes}) > 4
    for take in takes:
        lengths = [end - start for start, end in take.spans]
        assert min(lengths) >= 100 and max(lengths) <= 196
        assert 1200 <= take.spans[-1][1] < 1200 + 196 and len(take.joints) == take.spans[-1][1] + 1


def test_drift_is_seen_where_it_is():
    """A performer who does as told for a minute, and then stands still for the next."""
    rng = np.random.default_rng(0)
    source = [(clip.program[0], clip.labels[0][2]) for clip in toy_dataset("test", 200).clips]
    take = act_out(draw(source, 1, 48, 4, rng)[0], rng)
    half = next(start for start, _ in take.spans if start >= 1200)
    take.joints[half:] = take.joints[half]
    take = replace(take, prompts=[((segment,), said) for segment, said in take.prompts])
    row = drift.judged(take, 2, 1)
    assert row["finite"] == 1 and 0.8 < row["reach_m"] < 1.2 and row["frames_beyond"] == 0
    assert row["minutes 0-1"] > 0.9 and row["minutes 1-2"] < 0.2
    take.joints[7, 20, 0] += 2.0
    row = drift.judged(take, 2, 1)
    assert row["frames_beyond"] == 1 / len(take.joints) and row["reach_m"] > 2
    assert row["rigid_frames_beyond"] == 0 and row["rigid_reach_m"] < 1.2 and row["rigid_minutes 0-1"] > 0.9
    take.joints[half // 2 :] = np.nan
    row = drift.judged(take, 2, 1)
    assert row["finite"] == 0 and 0.2 < row["minutes 0-1"] < 0.8 and row["rigid_minutes 1-2"] < 0.2


def test_a_study_with_seeds_is_told_with_intervals():
    rows = [{"K": 20, "L": k % 2, "seed": k // 2, "fid": float(k)} for k in range(6)]
    told = studies.summary("masks", rows).splitlines()
    assert told[0].split() == ["K", "L", "fid"] and told[1].split() == ["20", "0", "2", "±", "5"]
    assert len(told) == 3  # two settings, three seeds each


def test_settings_of_one_model_are_compared_seed_by_seed(monkeypatch):
    monkeypatch.setattr(studies, "PAIRS", {"sampling": [("20 1", "20 0")]})
    rows = [{"K": 20, "L": L, "seed": seed, "fid": 100.0 * seed + L} for seed in range(3) for L in range(2)]
    rows.sort(key=lambda row: (row["L"], row["seed"] * (1 - 2 * row["L"])))  # the seeds of one setting come backwards
    last = studies.summary("sampling", rows).splitlines()[-1]
    assert last.strip().startswith("20 1 minus 20 0") and last.endswith(" 1 ± 0")
    assert studies.summary("sampling", rows[:-1]).splitlines()[-1].endswith(" 1 ± 0")  # a study that is under way
    assert "minus" not in studies.summary("sampling", rows[:3])


def test_small_models_of_one_name_are_one_model(tmp_path, monkeypatch):
    """A model is trained once and found again by its name, so two plans must never share one."""
    made, asked = {}, []

    def micro(scratch, name, plan, seed, vae_from=None):
        assert made.setdefault((name, seed), (plan, vae_from)) == (plan, vae_from)

    seams = {"transition_fid": {"mean": 0.0}, "auj": {"mean": 0.0}}
    monkeypatch.setattr(small, "micro", micro)
    found = {"oracle_accuracy": 0.0, "fid": 0.0}
    monkeypatch.setattr(small, "answers", lambda pipe, limit=0, **ask: asked.append(ask) or dict(found))
    monkeypatch.setattr(small, "reconstruction", lambda *_, **__: {"metrics": {"mpjpe_mm": {"mean": 0.0}}})
    monkeypatch.setattr(small, "timelines", lambda *_, **__: {"metrics": seams})
    for rows in (small.vae_rows, small.mask_rows, small.objective_rows, small.sampling_rows, small.grid_rows):
        labels = []
        for label, measure in rows(tmp_path):
            labels.append(tuple(label.values()))
            measure()
        assert len(set(labels)) == len(labels) and len(labels) % 3 == 0  # three seeds of each
    plans = [plan for (_, seed), (plan, _) in made.items() if seed == 0]
    # flow, sampling and a cell of the grid are causal-random again
    assert len(plans) == 3 + 4 + 1 + 13 and all(a != b for a, b in combinations(plans, 2))
    assert {ask.get("solver") for ask in asked} == {None, "euler", "ddpm", "ddim"}


def test_a_prompt_that_latents_in_flight_hear_comes_sooner():
    rows = [drift.reaction(10, reach, pairs=2, before=9, after=12) for reach in ("new", "active")]
    assert rows[1]["reaction_frames"] == 3 < rows[0]["reaction_frames"] <= 3 + 4 * 2  # 3 are left of a latent
    assert all(0 <= row["oracle_accuracy"] <= 1 for row in rows)


def test_a_probe_reads_the_words_and_padding_changes_nothing():
    found = reading.read(0, 150, 256)["ordinary"]
    assert found["action"] > 0.5 and found["all"] > 0.1
    blind = reading.read(0, 0, 256)["ordinary"]  # a probe that has learnt nothing
    assert blind["action"] < 0.3 and blind["all"] < 0.1
    torch.manual_seed(0)
    probe = reading.Probe(8, [["a", "b"], ["c", "d", "e"]]).eval()
    words = Words(torch.randn(2, 5, 8), torch.arange(5) < torch.tensor([[5], [3]]))
    other = Words(words.embeddings.masked_fill(~words.mask[..., None], 9.0), words.mask)
    for one, two, options in zip(probe(words), probe(other), (2, 3)):
        assert one.shape == (2, options)
        torch.testing.assert_close(one, two)
