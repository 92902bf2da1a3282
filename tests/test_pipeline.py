"""The pipeline: a motion is a function of prompt, length and seed alone, and what cannot be asked is said."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import minicmdm
from minicmdm import Motion, MotionPipeline, asking
from minicmdm.motion import load_joints
from minicmdm.pipeline import ASSETS
from minicmdm.training import checkpoints

PROMPT = "a person walks, then jumps twice"


@pytest.fixture(scope="module")
def pipe(tiny_run):
    """The tiny checkpoint with every weight moved off zero, or the text and the past would change nothing."""
    pipe = MotionPipeline.from_pretrained(tiny_run)
    generator = torch.Generator().manual_seed(0)
    for module in (pipe.dit, pipe.vae, pipe.text):
        for weight in module.parameters():
            weight.data += 0.1 * torch.randn(weight.shape, generator=generator)
    return pipe


def test_a_motion_is_what_was_asked_for(pipe):
    motion = pipe(PROMPT, num_frames=50)
    assert isinstance(motion, Motion) and motion.caption == PROMPT and motion.fps == 20
    assert motion.joints.shape == (50, 22, 3) and motion.joints.dtype == np.float32
    assert motion.features.shape == (50, 263) and np.isfinite(motion.features).all()
    assert len(motion) == 50 and motion.seconds == 2.5
    assert np.abs(motion.joints[0, 0, [0, 2]]).max() < 1e-6  # it begins at the origin


@pytest.mark.parametrize("frames", [4, 5, 196])
def test_shortest_and_longest(pipe, frames):
    assert pipe(PROMPT, frames, num_steps=2).joints.shape == (frames, 22, 3)


@pytest.mark.parametrize("schedule", ["fss", "full", "autoregressive"])
def test_same_seed_same_motion(pipe, schedule):
    first, again = (pipe(PROMPT, 40, schedule=schedule, num_steps=4, seed=3) for _ in range(2))
    other = pipe(PROMPT, 40, schedule=schedule, num_steps=4, seed=4)
    assert np.array_equal(first.joints, again.joints)
    assert np.abs(first.features - other.features).max() > 1e-3


def test_text_and_guidance_matter(pipe):
    said, other = (pipe(text, 40, num_steps=4).features for text in (PROMPT, "a person sits down"))
    plain = pipe(PROMPT, 40, num_steps=4, guidance_scale=1.0).features
    assert np.abs(said - other).max() > 1e-3 and np.abs(said - plain).max() > 1e-3
    no_text = pipe(PROMPT, 40, num_steps=4, guidance_scale=0.0).features
    null = pipe("a person sits down", 40, num_steps=4, guidance_scale=0.0).features
    np.testing.assert_allclose(no_text, null, atol=1e-5)


def test_a_motion_does_not_depend_on_its_batch(pipe):
    prompts = [PROMPT, "a person sits down", "waves", PROMPT]
    frames, seeds = [100, 30, 57, 100], [1, 2, 3, 9]
    together = pipe(prompts, frames, num_steps=5, seed=seeds)
    assert [len(motion) for motion in together] == frames and [m.caption for m in together] == prompts
    for prompt, count, seed, motion in zip(prompts, frames, seeds, together):
        alone = pipe(prompt, count, num_steps=5, seed=seed)
        np.testing.assert_allclose(motion.features, alone.features, atol=2e-4)
    assert np.abs(together[0].features - together[3].features).max() > 1e-3


def test_many_prompts_come_back_in_order(pipe, monkeypatch):
    monkeypatch.setattr("minicmdm.pipeline.TOGETHER", 2)
    frames = [44, 4, 80, 12, 8]
    motions = pipe([PROMPT] * 5, frames, num_steps=2)
    assert [len(motion) for motion in motions] == frames


def test_a_longer_motion_begins_like_the_shorter(pipe):
    """Causality from end to end: noise, sampler, DiT, decoder and recovery never look ahead."""
    short, long = (pipe(PROMPT, frames, num_steps=5, tell_length=False).joints for frames in (60, 120))
    np.testing.assert_allclose(long[:60], short, atol=2e-4)
    told = pipe(PROMPT, 120, num_steps=5).joints  # who knows the end may pace itself from the start
    assert np.abs(told[:60] - long[:60]).max() > 1e-3


def test_noise_of_the_caller_is_left_alone(pipe):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    pipe(PROMPT, 20, num_steps=2)
    assert torch.equal(before, torch.get_rng_state())


BAD_CALLS = {
    "empty": (dict(prompt=""), "prompt is empty"),
    "blank": (dict(prompt=" \n\t"), "prompt is empty"),
    "number": (dict(prompt=7), "prompt must be a string"),
    "none": (dict(prompt=None), "prompt must be a string"),
    "bytes": (dict(prompt=b"walk"), "prompt must be a string"),
    "no prompts": (dict(prompt=[]), "an empty list"),
    "one not a string": (dict(prompt=["walk", 3]), "prompt must be a string"),
    "half a character": (dict(prompt="walk \udcff"), "no text"),
    "too long": (dict(prompt="walk " * 500), "prompt is too long"),
    "no frames": (dict(num_frames=0), "from 4 .* to 196"),
    "3 frames": (dict(num_frames=3), "from 4 .* to 196"),
    "many frames": (dict(num_frames=100_000), "196 .9.8 s, the longest"),
    "half a frame": (dict(num_frames=40.5), "whole number"),
    "true frames": (dict(num_frames=True), "whole number"),
    "frames for two": (dict(num_frames=[40, 40]), "1 prompts need one value or 1"),
    "nan guidance": (dict(guidance_scale=math.nan), "guidance_scale"),
    "inf guidance": (dict(guidance_scale=math.inf), "guidance_scale"),
    "text guidance": (dict(guidance_scale="3"), "guidance_scale"),
    "schedule": (dict(schedule="ddim"), "full, autoregressive, fss"),
    "uncertainty": (dict(uncertainty=21), "uncertainty"),
    "negative uncertainty": (dict(uncertainty=-1), "uncertainty"),
    "no steps": (dict(num_steps=0), "num_steps"),
    "steps": (dict(num_steps=10**9), "num_steps"),
    "block": (dict(block_size=0), "block_size"),
    "seed": (dict(seed=-1), "seed"),
    "half a seed": (dict(seed=0.5), "seed"),
    "big seed": (dict(seed=2**64), "seed"),
}


@pytest.mark.parametrize("name", BAD_CALLS)
def test_bad_calls_teach(name, pipe):
    arguments, message = BAD_CALLS[name]
    with pytest.raises(ValueError, match=message):
        pipe(**({"prompt": PROMPT, "num_frames": 40} | arguments))


def test_numpy_integers_are_integers(pipe):
    assert len(pipe(PROMPT, np.int64(20), num_steps=np.int32(2), seed=np.int64(1))) == 20


def test_saved_pipeline_is_the_same_pipeline(tiny_pipe, tmp_path):
    folder = tiny_pipe.save_pretrained(tmp_path / "copy")
    copy = MotionPipeline.from_pretrained(folder)
    one, other = (p(PROMPT, 40, num_steps=3).joints for p in (tiny_pipe, copy))
    assert np.array_equal(one, other)
    ours = {**tiny_pipe.card, "files": {k: v for k, v in tiny_pipe.card["files"].items() if k in checkpoints.WEIGHTS}}
    assert copy.card == ours  # a pipeline holds no teacher
    assert {p.name for p in folder.iterdir()} == {
        "vae.safetensors",
        "dit.safetensors",
        "stats.safetensors",
        "text",
        "card.json",
    }


def test_unknown_checkpoints_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no checkpoint folder"):
        MotionPipeline.from_pretrained(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="no finished checkpoint"):
        MotionPipeline.from_pretrained(tmp_path)
    with pytest.raises(ValueError, match="empty"):
        MotionPipeline.from_pretrained("")


def test_encode_and_decode_are_inverse_in_scale(tiny_pipe, fake_data):
    latents = tiny_pipe.encode(fake_data.clips[0].features[None, :40])
    assert latents.shape == (1, 10, 4) and tiny_pipe.decode(latents).shape == (1, 40, 263)
    whole = tiny_pipe.reconstruct(fake_data.clips[0].features[:43])
    np.testing.assert_allclose(whole, tiny_pipe.decode(latents)[0], atol=1e-5)


@pytest.mark.parametrize("ending", [".npy", ".gif", ".html"])
def test_save_writes_whole_files_and_spares_old_ones(tiny_pipe, tmp_path, ending):
    motion = tiny_pipe("a person walks <b>& waves", 8, num_steps=2)
    path = motion.save(tmp_path / f"m{ending}")
    written = path.read_bytes()
    if ending == ".npy":
        np.testing.assert_array_equal(load_joints(path), motion.joints)
    assert written[:6] == {".npy": b"\x93NUMPY", ".gif": b"GIF89a"}.get(ending, written[:6])
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="--force"):
        motion.save(path)
    assert path.read_bytes() == b"mine"
    motion.save(path, force=True)
    assert path.read_bytes() == written
    assert len(list(tmp_path.iterdir())) == 1


def test_a_failed_save_leaves_the_old_file(tiny_pipe, tmp_path, monkeypatch):
    motion = tiny_pipe(PROMPT, 8, num_steps=2)
    path = motion.save(tmp_path / "m.html")
    before = path.read_bytes()

    def fail(self):
        raise RuntimeError("drawing failed")

    monkeypatch.setattr(Motion, "to_html", fail)
    with pytest.raises(RuntimeError):
        motion.save(path, force=True)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_show_opens_a_page_outside_notebooks(tiny_pipe, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    tiny_pipe(PROMPT, 8, num_steps=2).show()
    assert opened[0].startswith("file://") and opened[0].endswith(".html")


def test_public_names_all_exist():
    for name in minicmdm.__all__:
        assert getattr(minicmdm, name) is not None
    assert set(minicmdm.__all__) <= set(dir(minicmdm))
    with pytest.raises(AttributeError, match="no attribute 'motoin'"):
        minicmdm.motoin  # noqa: B018


def test_shipped_checkpoint_walks():
    """The one test of the shipped weights: loads, fits in 12 MB, and a walk gets somewhere."""
    folder = ASSETS / "toy"
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < 12e6
    assert json.loads((folder / "card.json").read_text(encoding="utf-8"))["fast"] is False
    motion = MotionPipeline.from_pretrained("toy")("a person walks forward", 80)
    assert np.linalg.norm(motion.joints[-1, 0, [0, 2]]) > 0.5


@pytest.mark.parametrize("how", [{}, {"schedule": "autoregressive"}, {"schedule": "full"}, {"tell_length": False}])
@pytest.mark.parametrize("attention", ["causal", "window"])
def test_the_cached_way_gives_what_the_dense_one_gives(pipe, how, attention, monkeypatch):
    """DDIM with eta = 0 is Euler's step, and only Euler has the stream."""
    cfg = replace(pipe.preset.dit, attention=attention)
    monkeypatch.setattr(pipe, "preset", replace(pipe.preset, dit=cfg))
    monkeypatch.setattr(pipe.dit, "cfg", cfg)
    prompts, frames = ["a person walks", "a person jumps twice", "he sits down"], [33, 60, 36]
    fast = pipe(prompts, frames, num_steps=4, seed=[1, 2, 3], **how)
    slow = pipe(prompts, frames, num_steps=4, seed=[1, 2, 3], solver="ddim", **how)
    for one, other in zip(fast, slow):
        assert one.features.shape == other.features.shape
        np.testing.assert_allclose(one.features, other.features, atol=2e-4)


def test_solvers_differ_and_unknown_ones_are_refused(pipe):
    euler, heun, ddpm = (pipe("a person walks", 40, num_steps=4, solver=name) for name in ("euler", "heun", "ddpm"))
    assert np.abs(euler.features - heun.features).max() > 1e-5 < np.abs(euler.features - ddpm.features).max()
    again = pipe("a person walks", 40, num_steps=4, solver="ddpm")
    assert np.array_equal(ddpm.features, again.features)  # its new noise comes from the seed, too
    with pytest.raises(ValueError, match="unknown solver 'leapfrog'"):
        pipe("a person walks", solver="leapfrog")


def test_batches_are_near_in_length_or_alike():
    lengths = [5, 3, 5, 3, 5, 9]
    assert list(asking.batches(lengths, 4, alike=False)) == [[1, 3, 0, 2], [4, 5]]
    assert list(asking.batches(lengths, 2, alike=True)) == [[1, 3], [0, 2], [4], [5]]
    assert list(asking.batches([], 2, alike=True)) == []
