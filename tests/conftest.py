"""What every test shares: one thread, no network, and a tiny trained checkpoint made from a made-up data set."""

import os

# Before torch is imported: on a busy machine two threads are slower than one.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ["HF_HUB_OFFLINE"] = "1"

from dataclasses import replace  # noqa: E402

import numpy as np  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402

from minicmdm.config import DiTConfig, Preset, TextConfig, TMRConfig, TrainConfig, VAEConfig  # noqa: E402
from minicmdm.data.dataset import Clip, MotionDataset  # noqa: E402

torch.set_num_threads(1)


def make_fake_data(count: int = 12, seed: int = 0) -> MotionDataset:
    """Smooth waves instead of motion: lengths 40 to 100, one to three labelled segments each."""
    rng = np.random.default_rng(seed)
    verbs = ["walks", "runs", "waves the left hand", "jumps twice", "sits down"]
    clips = []
    for number in range(count):
        length = int(rng.integers(40, 101))
        phase = rng.uniform(0, 6, 263)
        features = 0.1 * np.sin(np.arange(length)[:, None] * 0.2 + phase)
        parts = int(rng.integers(1, 4))
        cuts = [length * part // parts for part in range(parts + 1)]
        said = [f"a person {verbs[rng.integers(len(verbs))]}" for _ in range(parts)]
        labels = list(zip(cuts[:-1], cuts[1:], said))
        clips.append(Clip(f"{number:06d}", features.astype(np.float32), [", then ".join(said)], labels))
    stacked = np.concatenate([clip.features for clip in clips])
    return MotionDataset(clips, stacked.mean(0), stacked.std(0) + 1e-3, "fake")


def make_tiny_preset(**train) -> Preset:
    """A preset that trains in a second."""
    steps = dict(vae_steps=12, vae_batch=4, vae_lr=1e-3, vae_warmup=2, crop_frames=32)
    steps |= dict(evaluator_steps=12, evaluator_batch=4, tmr_steps=12, tmr_batch=4, tmr_lr=1e-3, tmr_warmup=2)
    steps |= dict(dit_steps=12, dit_batch=4, dit_lr=1e-3, dit_warmup=2, ema=0.9)
    return Preset(
        "tiny",
        VAEConfig(latent_dim=4, width=16, depth=1),
        TextConfig(dim=16, layers=1, heads=2, vocab_size=100, max_words=24),
        TMRConfig(dim=16, layers=1, heads=2, embed_dim=8, dropout=0.0),
        DiTConfig(latent_dim=4, text_dim=16, dim=16, layers=2, heads=2, time_dim=16, clock=True),
        replace(TrainConfig(), **(steps | train)),
    )


@pytest.fixture(scope="session")
def fake_data() -> MotionDataset:
    """Twelve clips that nobody may change."""
    return make_fake_data()


@pytest.fixture(scope="session")
def tiny_preset() -> Preset:
    return make_tiny_preset()


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory, fake_data, tiny_preset):
    """The folder of one whole training run, every stage; tests that change files work on a copy."""
    from minicmdm.training import stages

    folder = tmp_path_factory.mktemp("run") / "tiny"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "preset", lambda name, system: tiny_preset)
        patch.setattr(stages, "_datasets", lambda *_: (fake_data, make_fake_data(4, seed=1)))
        stages.train("tiny", folder, progress=False)
    # As after much training, nothing is exactly zero: a zero output layer would hide what tests look for.
    return folder


@pytest.fixture(scope="session")
def tiny_pipe(tiny_run):
    from minicmdm.pipeline import MotionPipeline

    return MotionPipeline.from_pretrained(tiny_run)
