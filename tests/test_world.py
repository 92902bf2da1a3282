"""The toy world: programs, their English, and bodies that obey (bones, floor, feet, accelerations)."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from minicmdm.data import dataset, folders, grammar
from minicmdm.data.programs import (
    ACTIONS,
    HELDOUT_PAIRS,
    OVERLAYS,
    Segment,
    agrees,
    pairs_of,
    realise,
    sample_program,
    sample_segment,
    score,
)
from minicmdm.data.skeleton import BONE_LENGTHS, PARENTS
from minicmdm.data.synthesis import synthesise


@pytest.fixture(scope="module")
def performances():
    """120 random programs acted out."""
    rng = np.random.default_rng(7)
    out = []
    while len(out) < 120:
        program = sample_program(rng, heldout=rng.random() < 0.3)
        performance = synthesise(program, rng)
        if performance is not None:
            out.append((program, performance))
    return out


def test_bones_keep_their_lengths(performances):
    for _, performance in performances:
        bones = performance.joints[:, 1:] - performance.joints[:, np.array(PARENTS)[1:]]
        np.testing.assert_allclose(
            np.linalg.norm(bones, axis=-1), np.broadcast_to(BONE_LENGTHS[1:], bones.shape[:2]), atol=1e-5
        )


def test_nothing_goes_through_the_floor_and_feet_touch_it(performances):
    for _, performance in performances:
        assert performance.joints[..., 1].min() > -0.01
        assert performance.joints[:, [10, 11], 1].min() < 0.03


def test_planted_feet_do_not_skate(performances):
    ratios = []
    for _, performance in performances:
        feet = performance.joints[:, [10, 11]]
        speed = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1) * 20
        down = (feet[:-1, :, 1] < 0.05) & (feet[1:, :, 1] < 0.05)
        mean = uniform_filter1d(speed, 5, axis=0, mode="constant")
        ratios.append((down & (speed > 0.5) & (mean > 0.5)).any(1).mean())
    assert np.mean(ratios) < 0.02


def test_accelerations_are_those_of_a_body(performances):
    """Peaks of 130 m/s² occur in a real captured clip; a teleport of 10 cm would be 40 (two frames of it) to 4000."""
    peaks = [np.linalg.norm(np.diff(p.joints, 2, axis=0), axis=-1).max() * 400 for _, p in performances]
    assert max(peaks) < 150 and np.median(peaks) > 10


def test_lengths_fit_what_the_model_trains_on(performances):
    for _, performance in performances:
        frames = len(performance.joints) - 1
        assert 40 <= frames <= 196 and frames % 4 == 0
        ends = [s.end for s in performance.program]
        assert ends == sorted(ends) and ends[-1] <= frames
        assert performance.program[0].start > 0


def test_one_sentence_has_many_motions():
    program = (Segment("walk"),)
    first, second = (synthesise(program, np.random.default_rng(seed)) for seed in (1, 2))
    frames = min(len(first.joints), len(second.joints))
    assert np.abs(first.joints[:frames] - second.joints[:frames]).max() > 0.1
    again = synthesise(program, np.random.default_rng(1))
    np.testing.assert_array_equal(first.joints, again.joints)


def test_training_never_contains_a_heldout_pair():
    rng = np.random.default_rng(0)
    assert len(HELDOUT_PAIRS) >= 30
    for _ in range(2000):
        assert not HELDOUT_PAIRS & set(pairs_of(sample_program(rng)))
    for _ in range(300):
        assert HELDOUT_PAIRS & set(pairs_of(sample_program(rng, heldout=True)))


def test_every_action_is_common_and_every_field_occurs():
    rng = np.random.default_rng(0)
    segments = [s for _ in range(3000) for s in sample_program(rng)]
    assert {s.action for s in segments} == set(ACTIONS)
    assert {s.overlay for s in segments} == {None, *OVERLAYS}
    assert {s.count for s in segments} == {None, 1, 2, 3}
    assert len(ACTIONS) >= 18
    stated = [
        sum(getattr(s, f) is not None for f in ("side", "direction", "speed", "count", "overlay")) for s in segments
    ]
    assert np.mean(np.array(stated) > 0) > 0.5  # difficulty lies in the fields


def test_realise_fills_every_field_and_changes_none():
    rng = np.random.default_rng(3)
    for name in ACTIONS:
        for _ in range(20):
            asked = sample_segment(rng, name)
            full = realise(rng, asked)
            assert agrees(asked, full)
            action = ACTIONS[name]
            assert (full.side is not None) == action.side
            assert (full.direction is not None) == action.direction
            assert (full.speed is not None) == action.speed


def test_grammar_has_words_and_paraphrases_and_states_the_fields():
    rng = np.random.default_rng(0)
    words = set()
    for _ in range(4000):
        words |= set(grammar.caption(rng, sample_program(rng)).replace(",", " ").replace(".", " ").split())
    assert len(words) >= 150
    for name, (phrases, held) in grammar.PHRASES.items():
        assert len(phrases) >= 3 and len(held) >= 1, name
        assert not set(phrases) & set(held), name
    kick = Segment("kick", side="left", count=3)
    for _ in range(30):
        text = grammar.clause(rng, kick)
        assert "left" in text and ("three" in text or "thrice" in text)
        assert "left" not in grammar.clause(rng, replace(kick, side=None))


def test_captions_never_leave_a_mark_unfilled():
    rng = np.random.default_rng(1)
    for i in range(3000):
        text = grammar.caption(rng, sample_program(rng), heldout=bool(i % 2))
        assert not set("{}|") & set(text) and "  " not in text and text == text.strip()


def test_a_segment_told_backwards_still_says_the_same_deeds():
    rng = np.random.default_rng(5)
    program = (Segment("walk"), Segment("clap"))
    told = {grammar.caption(rng, program) for _ in range(300)}
    assert any(" after " in t and t.index("clap") < t.index(" after ") for t in told if "clap" in t)


def test_score_counts_place_and_spurious_segments():
    a, b, c = Segment("walk"), Segment("jump", count=2), Segment("sit")
    assert score((a, b), (a, b)) == (2, 2)
    assert score((a, b), (b, a)) == (0, 2)
    assert score((a, b), (a, replace(b, count=3))) == (1, 2)
    assert score((a,), (a, c)) == (1, 2)
    assert score((b, c), (a, b, c)) == (0, 3)


def test_clips_are_the_same_each_time_and_labels_cover_them():
    one, two = dataset.make_clip("train", 5), dataset.make_clip("train", 5)
    np.testing.assert_array_equal(one.features, two.features)
    assert one.captions == two.captions and len(one.captions) >= 3
    assert one.labels[0][0] == 0 and one.labels[-1][1] == len(one.features)
    assert all(a[1] == b[0] for a, b in zip(one.labels, one.labels[1:]))
    assert dataset.make_clip("val", 5).captions != one.captions


def test_test_split_holds_its_kinds():
    clips = [dataset.make_clip("test", i) for i in range(16)]
    assert [c.kind for c in clips[:4]] == ["ordinary", "paraphrase", "ordinary", "pairs"]
    assert all(dataset.unseen_pairs(c) == (c.kind == "pairs") for c in clips)


def test_folder_round_trip(tmp_path):
    made = dataset.toy_dataset("val", 3)
    folder = dataset.make_folder(tmp_path / "toy", {"val": 3}, progress=False)
    read = folders.load_dataset(folder, "val")
    for a, b in zip(made.clips, read.clips):
        np.testing.assert_array_equal(a.features, b.features)
        assert (a.captions, a.labels, a.program, a.realised) == (b.captions, b.labels, b.program, b.realised)
    np.testing.assert_array_equal(made.mean, read.mean)
    assert read.fingerprint == dataset.world_fingerprint()
    with pytest.raises(FileExistsError, match="--force"):
        dataset.make_folder(tmp_path / "toy", {"val": 1}, progress=False)
    assert len(folders.load_dataset(folder, "val")) == 3


def test_reader_errors_teach(tmp_path):
    with pytest.raises(FileNotFoundError, match="train.txt"):
        folders.load_dataset(tmp_path)
    folder = dataset.make_folder(tmp_path / "toy", {"val": 2}, progress=False)
    name = (folder / "val.txt").read_text().split()[0]
    np.save(folder / "new_joint_vecs" / f"{name}.npy", np.zeros((60, 100), np.float32))
    with pytest.raises(ValueError, match="263"):
        folders.load_dataset(folder, "val")
    (folder / "new_joint_vecs" / f"{name}.npy").unlink()
    with pytest.raises(FileNotFoundError, match=name):
        folders.load_dataset(folder, "val")


def test_committed_sample_is_of_this_world():
    """The sample and the datasheet carry the fingerprint of the sources; whoever changes the world must say why."""
    from pathlib import Path

    root = Path(__file__).parents[1] / "data_toy"
    sample = folders.load_dataset(root / "sample", "train")
    assert len(sample) == 24 and sample.fingerprint == dataset.world_fingerprint()
    assert f"`{sample.fingerprint}`" in (root / "README.md").read_text(encoding="utf-8")
    fresh = dataset.make_clip("train", 0)
    np.testing.assert_allclose(sample.clips[0].features, fresh.features, atol=1e-5)
    assert sample.clips[0].captions == fresh.captions
    lines = (root / "sample" / "programs.jsonl").read_text(encoding="utf-8").splitlines()
    assert all({"name", "asked", "realised", "labels"} <= set(json.loads(line)) for line in lines)
