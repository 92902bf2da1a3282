"""The oracle agrees with the truth, survives noise and turning, and can say no (DESIGN.md invariant 7)."""

from dataclasses import replace

import numpy as np
import pytest

from minicmdm.data.dataset import toy_dataset
from minicmdm.data.features import features_to_joints, mirror_joints
from minicmdm.data.oracle import read_motion
from minicmdm.data.programs import ACTIONS, Segment, score
from minicmdm.data.synthesis import synthesise

COUNT = 240
FLIP = {"left": "right", "right": "left", "wave_left": "wave_right", "wave_right": "wave_left"}
WAYS = {"walk", "run", "walk_backward", "sidestep", "circle", "crouch_walk", "turn", "spin"}


def passes(asked, found) -> bool:
    right, of = score(asked, tuple(found))
    return right == of


@pytest.fixture(scope="module")
def clips():
    return toy_dataset("test", COUNT).clips


@pytest.fixture(scope="module")
def motions(clips):
    return [features_to_joints(c.features) for c in clips]


@pytest.fixture(scope="module")
def readings(motions):
    return [read_motion(j) for j in motions]


def segment_accuracy(programs, readings) -> float:
    pairs = [score(p, tuple(r)) for p, r in zip(programs, readings)]
    return sum(r for r, _ in pairs) / sum(m for _, m in pairs)


def test_agrees_with_the_truth_in_every_field(clips, readings):
    assert segment_accuracy([c.realised for c in clips], readings) >= 0.97


def test_survives_a_centimetre_of_noise_and_any_yaw(clips, motions):
    rng = np.random.default_rng(0)
    noisy = []
    for joints in motions:
        c, s = np.cos(a := rng.uniform(0, 2 * np.pi)), np.sin(a)
        turned = joints @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + np.array([3.0, 0, -2.0])
        noisy.append(read_motion(turned + rng.normal(0, 0.01, joints.shape)))
    assert segment_accuracy([c.realised for c in clips], noisy) >= 0.97


@pytest.mark.parametrize("action", ACTIONS)
def test_reads_each_action_alone(action):
    rng = np.random.default_rng(11)
    right = 0
    for _ in range(8):
        performance = None
        while performance is None:
            performance = synthesise((Segment(action, count=2 if ACTIONS[action].counted else None),), rng)
        right += passes(performance.program, read_motion(performance.joints))
    assert right >= 7


def test_starts_and_ends_are_near_the_truth(clips, readings):
    gaps = [
        abs(found.start - asked.start)
        for clip, reading in zip(clips, readings)
        if passes(clip.realised, reading)
        for asked, found in zip(clip.realised[1:], reading[1:])
    ]
    assert np.median(gaps) <= 8


def test_says_no_to_another_sentence(clips, readings):
    """A motion passes under another program exactly as often as the two programs coincide, within a point."""
    passed = coincide = total = 0
    for i, reading in enumerate(readings):
        for k, other in enumerate(clips):
            if i != k:
                total += 1
                passed += passes(other.program, reading)
                coincide += passes(other.program, clips[i].realised)
    assert abs(passed - coincide) / total < 0.01


def test_says_no_to_a_frozen_motion(clips, motions):
    held = {"stand", "sit", "raise_arms"}  # a still body may well be doing these
    frozen = [(c, np.repeat(j[:1], len(j), 0)) for c, j in zip(clips, motions)]
    frozen += [(c, np.repeat(j[len(j) // 2 :][:1], len(j), 0)) for c, j in zip(clips, motions)]
    for clip, joints in frozen:
        if not all(s.action in held for s in clip.realised):
            assert not passes(clip.realised, read_motion(joints))


def test_says_no_to_a_reversed_motion_where_it_must(clips, motions):
    checked = wrong = 0
    for clip, joints in zip(clips, motions):
        if any(s.action in WAYS for s in clip.realised):
            checked += 1
            backwards = [s for s in clip.realised[::-1]]
            same = len(backwards) == 1 and backwards[0].action == "sidestep"
            wrong += passes(clip.realised, read_motion(joints[::-1])) and not same
    assert checked > 50 and wrong <= 0.01 * checked


def test_a_mirrored_motion_is_read_mirrored(clips, motions):
    def mirrored(s: Segment) -> Segment:
        return replace(s, **{f: FLIP.get(getattr(s, f), getattr(s, f)) for f in ("side", "direction", "overlay")})

    readings = [read_motion(mirror_joints(j)) for j in motions]
    truth = [tuple(mirrored(s) for s in c.realised) for c in clips]
    assert segment_accuracy(truth, readings) >= 0.97
    sided = [(c.realised, r) for c, t, r in zip(clips, truth, readings) if t != c.realised]
    assert len(sided) > 100 and sum(passes(p, r) for p, r in sided) == 0


@pytest.mark.parametrize("frames", [4, 5, 12, 24, 25, 26])
def test_short_clips_are_read_too(motions, frames):
    for joints in motions[:40]:
        reading = read_motion(joints[30 : 30 + frames])
        assert reading and all(0 <= s.start < s.end <= frames for s in reading)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="22, 3"):
        read_motion(np.zeros((10, 21, 3)))
    with pytest.raises(ValueError, match="finite"):
        read_motion(np.full((10, 22, 3), np.nan))
