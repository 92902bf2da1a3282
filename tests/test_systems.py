"""The systems through the same doors: trained, loaded, asked, edited, and each refuses what it cannot do."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from conftest import make_fake_data
from model_helpers import randomise

from minicmdm.config import PRESETS, SYSTEMS, Preset, as_system, preset
from minicmdm.data.features import features_of, features_to_joints
from minicmdm.pipeline import MotionPipeline
from minicmdm.systems import MASKED, new_denoiser
from minicmdm.training import stages


@pytest.fixture(scope="module", params=SYSTEMS)
def run(request, tmp_path_factory, fake_data, tiny_preset):
    """A system's folder after a whole training of a second."""
    folder = tmp_path_factory.mktemp("systems") / request.param
    plan = as_system(tiny_preset, request.param)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "_datasets", lambda *_: (fake_data, make_fake_data(4, seed=1)))
        for stage in ("tmr", "vae", "dit"):
            stages.train(plan, folder, stage, progress=False)
    return folder


@pytest.fixture(scope="module")
def pipe(run):
    pipe = MotionPipeline.from_pretrained(run)
    randomise(pipe.dit).float()
    return pipe


def test_the_card_says_which_system_it_is(run, pipe):
    assert pipe.preset.system == run.name == pipe.card["preset"]["system"]
    assert Preset.from_dict(pipe.preset.to_dict()) == pipe.preset
    assert pipe.preset.vae.input_dim == {"mardm": 67, "cdamd": 66}.get(run.name, 263)


def test_a_motion_is_its_own_prompt_length_and_seed(pipe):
    prompts, frames = ["a person walks", "a person jumps twice, then runs"], [24, 41]
    both = pipe(prompts, frames, seed=[3, 4], num_steps=4)
    alone = pipe(prompts[1], 41, seed=4, num_steps=4)
    assert [m.joints.shape for m in both] == [(24, 22, 3), (41, 22, 3)]
    assert np.allclose(both[1].joints, alone.joints, atol=1e-4)
    assert np.allclose(features_to_joints(both[0].features)[:, 1:, 1], both[0].joints[:, 1:, 1], atol=1e-3)
    for other in (pipe(prompts[1], 41, seed=5, num_steps=4), pipe(prompts[0], 41, seed=4, num_steps=4)):
        assert not np.allclose(other.joints, alone.joints, atol=1e-3)


def test_what_judges_read_is_there(pipe):
    motion = pipe("a person walks", 40, num_steps=2)
    assert len(motion.features) == 40 and motion.features.shape[1] in (67, 263)
    rebuilt = pipe.reconstruct(make_fake_data(1, seed=5).clips[0].features[:41])
    assert len(rebuilt) == 40 and rebuilt.shape[1] in (67, 263)


def test_save_and_load(pipe, tmp_path):
    again = MotionPipeline.from_pretrained(pipe.save_pretrained(tmp_path / "copy"))
    a, b = (one("a person sits down", 32, seed=1, num_steps=3) for one in (pipe, again))
    assert type(again) is type(pipe) and np.array_equal(a.joints, b.joints)


def test_editing_keeps_what_is_given(pipe):
    clip = make_fake_data(1, seed=8).clips[0]
    joints = features_to_joints(clip.features)[:48].astype(np.float32)
    from minicmdm.motion import Motion

    motion = Motion(joints, caption="a person walks")
    whole = features_of(joints.astype(np.float64))
    first = pipe.edit(motion, "first_half", seed=1)
    assert len(first) == 48 and np.isfinite(first.joints).all()
    # Six latents of twelve are given. The decoder may look ahead, so only latents are the same for sure.
    z = pipe.encode(whole[None, :24].astype(np.float32))
    for prompt in ("a person runs", "a person jumps twice"):
        with torch.no_grad():
            filled = pipe._fill(
                torch.cat([z, torch.zeros_like(z)], 1),
                torch.arange(12) < 6,
                prompt,
                torch.Generator().manual_seed(0),
                pipe._asked(None, 2, None, None, 3.0, None),
            )
        assert torch.equal(filled[:, :6], z) and filled[:, 6:].abs().min() > 0
    if pipe.preset.system in MASKED:
        for given in ("second_half", "ends", "middle"):
            assert len(pipe.edit(motion, given, "a person runs")) == 48
    else:
        with pytest.raises(ValueError, match="first_half"):
            pipe.edit(motion, "second_half")
    with pytest.raises(ValueError, match="given"):
        pipe.edit(motion, "prefix")
    with pytest.raises(ValueError, match="15 frames"):
        pipe.edit(Motion(joints[:15], caption="a person walks"))


def test_those_with_levels_stream(pipe):
    if pipe.preset.system in MASKED:
        with pytest.raises(ValueError, match="to stream, take"):
            pipe.stream("a person walks")
        with pytest.raises(ValueError, match="schedule"):
            pipe("a person walks", 20, schedule="fss")
        return
    dense = pipe("a person walks", 40, seed=2, tell_length=False, num_steps=4, uncertainty=2, schedule="triangular")
    stream = pipe.stream("a person walks", seed=2, lasts=None, num_steps=4, uncertainty=2, schedule="triangular")
    frames = np.stack([next(stream) for _ in range(40)])
    assert np.allclose(frames, dense.joints, atol=1e-4)


def test_each_samples_in_its_own_way_unless_told(pipe):
    flood = ("triangular", 10, 2)
    usual = {"cmdm": ("fss", 20, 2), "flood": flood, "window": flood}.get(pipe.preset.system, ("full", 10, 0))
    assert tuple(pipe.sampling(None, None, None).values()) == usual
    if pipe.preset.system not in MASKED:
        assert tuple(pipe.sampling("autoregressive", 7, None).values()) == ("autoregressive", 7, 2)


def test_systems_differ_in_what_is_theirs_alone():
    base = PRESETS["toy"]
    for system in SYSTEMS:
        plan = preset("toy", system)
        assert plan.system == system and plan.text == base.text and plan.tmr == base.tmr
        layers = 4 if system in MASKED else 6  # the others' weights are in the head
        assert replace(plan.dit, attention="causal") == replace(base.dit, layers=layers)  # the same clock
        weights = sum(w.numel() for w in new_denoiser(plan).parameters())
        assert 0.9 < weights / sum(w.numel() for w in new_denoiser(base).parameters()) < 1.15
        same = {f.name for f in fields(plan.train) if getattr(plan.train, f.name) == getattr(base.train, f.name)}
        changed = {f.name for f in fields(plan.train)} - same
        # never batches or rates; steps, where one takes longer
        assert changed <= {"levels", "align_weight", "kl_weight", "root_weight", "dit_steps"}
    with pytest.raises(ValueError, match="unknown system 'mdm'"):
        preset("toy", "mdm")


@pytest.mark.parametrize("target", ["x0", "eps"])
def test_other_targets_train_and_sample(target, tmp_path, monkeypatch, fake_data, tiny_preset):
    plan = as_system(tiny_preset, "flood")
    plan = replace(plan, dit=replace(plan.dit, target=target))
    monkeypatch.setattr(stages, "_datasets", lambda *_: (fake_data, make_fake_data(4, seed=1)))
    for stage in ("tmr", "vae", "dit"):
        stages.train(plan, tmp_path / "run", stage, progress=False)
    pipe = MotionPipeline.from_pretrained(tmp_path / "run")
    assert np.isfinite(pipe("a person walks", 32, num_steps=4).joints).all()
    with pytest.raises(ValueError, match="no velocity"):
        pipe.stream("a person walks")
