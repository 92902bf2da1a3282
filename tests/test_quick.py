"""The quick protocol: its scores on hand-made cases, its baseline, and its flat contract on a tiny pipeline."""

from dataclasses import replace

import numpy as np

from minicmdm.data.dataset import toy_dataset
from minicmdm.data.programs import Segment
from minicmdm.evaluation import quick

WALK, JUMP, SIT = Segment("walk", speed="slow"), Segment("jump", count=2), Segment("sit")


def test_segment_and_clip_accuracy_by_hand():
    asked = [(WALK, JUMP), (SIT,)]
    assert quick.segment_accuracy(asked, asked) == 1
    found = [(WALK, replace(JUMP, count=3)), (SIT, WALK)]
    assert quick.segment_accuracy(asked, found) == 2 / 4  # walk and sit right; of 2 asked, and 2 found for 1
    assert quick.clip_accuracy(asked, found) == 0
    assert quick.clip_accuracy(asked, [(WALK, JUMP), ()]) == 0.5


def test_unstated_fields_are_not_graded():
    asked = [(replace(WALK, speed=None),)]
    assert quick.segment_accuracy(asked, [(WALK,)]) == 1
    assert quick.field_accuracy(asked, [(WALK,)]) == {"action": 1.0}
    assert quick.field_accuracy([(WALK,)], [(replace(WALK, speed="fast"),)]) == {"action": 1.0, "speed": 0.0}
    assert quick.field_accuracy([(WALK, JUMP)], [(WALK,)])["count"] == 0.0


def test_nearest_words_returns_the_clip_that_says_the_same():
    clips = toy_dataset("train", 12).clips
    own = quick.nearest_words(clips, clips)
    assert quick.clip_accuracy([c.program for c in clips], own) >= 11 / 12  # its own motion, read by the oracle
    others = quick.nearest_words(clips[:6], clips[6:])
    assert quick.clip_accuracy([c.program for c in clips[:6]], others) < 0.5


def test_shuffle_keeps_the_words_and_loses_the_order():
    rng = np.random.default_rng(0)
    text = "a person walks slowly, then jumps twice"
    mixed = quick._shuffle(rng, text)
    assert sorted(mixed.split()) == sorted(text.split()) and mixed != text


def test_quick_numbers_are_flat_and_complete(tiny_pipe, monkeypatch):
    def few(split, *_, **__):
        """Eight clips, with a caption that the tiny text encoder can hold."""
        data = toy_dataset(split, 8)
        clips = [replace(clip, captions=["a walk"]) for clip in data.clips]
        return replace(data, clips=clips)

    monkeypatch.setattr(quick, "toy_dataset", few)
    numbers = quick.evaluate_quick(tiny_pipe, progress=False, num_steps=2, uncertainty=1)
    wanted = "oracle_accuracy _heldout _clip _gt _nearest _nearest_heldout _shuffled".split()
    assert {"oracle_accuracy" + k for k in ["", *wanted[1:]]} | {"mpjpe_mm", "seconds"} <= set(numbers)
    assert all(isinstance(v, (int, float, str)) for v in numbers.values())
    assert numbers["oracle_accuracy_gt"] > 0.9 and numbers["oracle_accuracy"] < 0.5  # an untrained model knows nothing
    assert numbers["mpjpe_mm"] > 30
