"""Training: batches say what the data say, losses fall, and a run that was killed ends where an unbroken one does."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import make_fake_data
from torch import nn

from minicmdm.models.dit import CausalDiT
from minicmdm.models.text import Words
from minicmdm.models.vae import MACVAE, vae_loss
from minicmdm.models.wordcache import WordCache
from minicmdm.training import batches, checkpoints, denoiser, representation, stages
from minicmdm.training.loop import LoopConfig, fit, learning_rate, step_key


@pytest.fixture
def tiny_world(monkeypatch, fake_data):
    """stages.train on the made-up data, with a preset of the caller's."""

    def use(preset):
        monkeypatch.setattr(stages, "preset", lambda name, system: preset)
        monkeypatch.setattr(stages, "_datasets", lambda *_: (fake_data, make_fake_data(4, seed=1)))

    return use


@pytest.fixture(scope="module")
def latents(fake_data, tiny_preset):
    torch.manual_seed(0)
    latents = batches.encode_dataset(MACVAE(tiny_preset.vae), fake_data)
    latents.stds = [1e-3 * std for std in latents.stds]  # narrow, as a trained VAE's are
    return latents


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_crops_are_pieces_of_clips(fake_data):
    for seed in range(20):
        crops = batches.crop_features(fake_data, 5, 64, generator(seed))[0].numpy() * fake_data.std + fake_data.mean
        assert crops.shape[1] == 64 or 40 <= crops.shape[1] < 64  # short clips come in batches of their own
        for crop in crops:
            homes = [
                start
                for clip in fake_data.clips
                for start in range(len(clip.features) - len(crop) + 1)
                if np.allclose(clip.features[start : start + len(crop)], crop, atol=1e-5)
            ]
            assert homes
    lengths = {batches.crop_features(fake_data, 2, 64, generator(seed))[0].shape[1] for seed in range(40)}
    assert 64 in lengths and len(lengths) > 1


@pytest.mark.parametrize("causal", [True, False])
def test_latents_are_normalised_and_company_changes_nothing(fake_data, tiny_preset, causal):
    """A clip's latents are those of the clip alone, for an encoder that looks ahead as well."""
    torch.manual_seed(1)
    vae = MACVAE(replace(tiny_preset.vae, causal=causal))
    latents = batches.encode_dataset(vae, fake_data)
    for clip, mean, std in zip(fake_data.clips, latents.means, latents.stds):
        whole = len(clip.features) // 4 * 4
        x = torch.from_numpy((clip.features[:whole] - fake_data.mean) / fake_data.std)
        alone, logvar = (part[0].detach() for part in vae.encode(x[None]))
        torch.testing.assert_close(mean * latents.scale + latents.shift, alone, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(std * latents.scale, (0.5 * logvar).exp(), atol=1e-5, rtol=1e-4)
    means, stds = torch.cat(latents.means), torch.cat(latents.stds)
    samples = torch.cat([means + stds * torch.randn(means.shape, generator=generator(k)) for k in range(50)])
    assert samples.mean(0).abs().max() < 0.02 and (samples.std(0) - 1).abs().max() < 0.02


def test_latent_owner_is_the_segment_of_its_middle():
    clip = replace(make_fake_data(1).clips[0], labels=[(0, 10, "a"), (10, 24, "b"), (24, 40, "c")])
    owners = batches.latent_owners(clip, 10).tolist()
    # Latents hold frames 0-3, 4-7, 8-11, ...; the third one's middle, frame 10, is where "b" begins.
    assert owners == [0, 0, 1, 1, 1, 1, 2, 2, 2, 2]


def words_seen(batch, sample, latent):
    """Through words_per_latent, with every word replaced by a number of its own: which words does this latent see?"""
    length = 1 + max(len(sentence.split()) for sentence in batch.sentences)
    names = [["<s>", *sentence.split()] for sentence in batch.sentences]
    mask = torch.zeros(len(names), length, dtype=torch.bool)
    codes = torch.zeros(len(names), length, 1)
    for row, line in enumerate(names):
        mask[row, : len(line)] = True
        codes[row, : len(line), 0] = torch.arange(row * length, row * length + len(line))
    words, seen = batches.words_per_latent(Words(codes, mask), batch.choice, batch.owner)
    picked = words[sample, seen[sample, latent], 0].int().tolist()
    return [names[code // length][code % length] for code in picked]


@pytest.mark.parametrize("way", [batches.WHOLE, batches.SEGMENTS, batches.CROPPED])
def test_each_latent_sees_its_own_words(way, latents, fake_data):
    shares = [0.0, 0.0, 0.0]
    shares[way] = 1.0
    crops = 0
    for seed in range(4):
        batch = batches.draw_batch(latents, 3, 0.0, generator(seed), shares)
        for row in range(3):
            count = int(batch.valid[row].sum())
            # Find the clip again by its latents: a crop is always the end of a clip.
            fits = [
                (float((mean[-count:] - batch.z[row, :count]).abs().max()), i, len(mean) - count)
                for i, mean in enumerate(latents.means)
                if len(mean) >= count
            ]
            _, index, begin = min(fits)
            clip = fake_data.clips[index]
            crops += begin > 0
            for latent in range(count):
                middle = 4 * (begin + latent) + 2
                own = [sentence for start, end, sentence in clip.labels if start <= middle < end][0]
                expected = clip.captions[0] if way == batches.WHOLE else own
                assert words_seen(batch, row, latent) == ["<s>", *expected.split()]
    assert (crops > 0) == (way == batches.CROPPED)


def test_clips_without_labels_keep_their_caption(tiny_preset):
    data = make_fake_data(6)
    data = replace(data, clips=[replace(clip, labels=[]) for clip in data.clips])
    latents = batches.encode_dataset(MACVAE(tiny_preset.vae), data)
    batch = batches.draw_batch(latents, 4, 0.0, generator(), (0.0, 0.5, 0.5))
    assert set(batch.sentences) <= {clip.captions[0] for clip in data.clips}
    assert batch.choice.shape == (4, 1) and (batch.owner == 0).all()
    assert sorted(batch.valid.sum(1).tolist())[0] >= 10  # nothing is cut


def test_dropped_text_is_the_empty_sentence(latents):
    batch = batches.draw_batch(latents, 8, 1.0, generator())
    assert batch.sentences == [""] and (batch.choice == 0).all()
    dropped = total = 0
    for seed in range(60):
        batch = batches.draw_batch(latents, 8, 0.25, generator(seed))
        dropped += sum(batch.sentences[i] == "" for i in batch.choice[:, 0].tolist())
        total += 8
    assert 0.15 < dropped / total < 0.35


def test_learning_rate_rises_then_falls():
    config = LoopConfig(steps=100, lr=1.0, warmup=10)
    rates = [learning_rate(config, step) for step in range(100)]
    assert max(rates) == rates[9] == 1.0 and rates[0] == pytest.approx(0.1)
    assert all(a >= b for a, b in zip(rates[9:], rates[10:])) and rates[-1] < 0.03


def test_step_keys_do_not_collide():
    keys = {step_key(seed, step) for seed in range(20) for step in range(-2, 500)}
    assert len(keys) == 20 * 502 and all(0 <= key < 2**63 for key in keys)


def denoising_step(dit, words, latents, plan):
    draws = generator()
    return denoiser.denoising_loss(dit, words, batches.draw_batch(latents, 8, 0.0, draws), plan, 0.0, draws)


@pytest.mark.parametrize("attention", ["causal", "bidirectional", "window"])
def test_who_looks_ahead_learns_without_a_future(attention, latents, fake_data, tiny_preset, monkeypatch):
    """A sampler hides latents that wait; with independent levels, a mask that looks ahead must have met that."""
    seen = []

    def loss(dit, z, words, mask, visible, **more):
        seen.append((visible, more["committed"], more["t"]))
        return z.sum()

    monkeypatch.setattr(denoiser, "diffusion_forcing_loss", loss)
    plan = replace(tiny_preset, dit=replace(tiny_preset.dit, attention=attention))
    text = representation.new_text_encoder(tiny_preset, fake_data)
    batch, draws = batches.draw_batch(latents, 64, 0.0, generator()), generator()
    denoiser.denoising_loss(CausalDiT(plan.dit), WordCache(text, []), batch, plan, 0.0, draws)
    ((visible, committed, t),) = seen
    hidden = (batch.valid & ~visible).sum(1)
    assert not (visible & ~batch.valid).any() and visible[:, 0].all()
    assert not (visible[:, 1:] & ~visible[:, :-1]).any()  # what is hidden is the end
    assert (committed is not None) == (attention == "window")
    assert (hidden > 0).any() == (attention != "causal") and (hidden == 0).any()
    assert (t < 1).all()


def test_both_losses_fall_on_one_batch(latents, fake_data, tiny_preset):
    torch.manual_seed(0)
    vae, x = MACVAE(tiny_preset.vae), batches.crop_features(fake_data, 8, 32, generator())[0]
    words = WordCache(representation.new_text_encoder(tiny_preset, fake_data), batches.said(fake_data))
    dit = CausalDiT(tiny_preset.dit)
    cases = {
        "vae": (vae, lambda: vae_loss(vae(x, generator()), x, tiny_preset.train).recon),
        "dit": (dit, lambda: denoising_step(dit, words, latents, tiny_preset)),
    }
    for model, loss in cases.values():
        optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
        before = loss().item()
        for _ in range(60):
            value = loss()
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
        assert loss().item() < before - 0.2


def test_a_perfect_vae_has_no_error(fake_data):
    class Perfect(nn.Module):
        def encode(self, x):
            return x, x

        def decode(self, z):
            return z

    assert representation.reconstruction_mpjpe(Perfect(), fake_data, fake_data, count=2) < 1e-2


def same_weights(one, other, names=checkpoints.FILES):
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


class Killed(Exception):
    pass


def die_after(monkeypatch, module, name, calls):
    """Let a function of a module raise Killed on its (calls+1)-th call."""
    real, left = getattr(module, name), [calls]

    def fatal(*args, **kwargs):
        if left[0] == 0:
            raise Killed
        left[0] -= 1
        return real(*args, **kwargs)

    monkeypatch.setattr(module, name, fatal)


def test_resumed_run_equals_the_unbroken_one(tiny_run, tiny_preset, tiny_world, tmp_path):
    tiny_world(tiny_preset)
    out = tmp_path / "broken"
    # In mid-teacher, mid-VAE, mid-DiT.
    for module, function, calls in (
        (representation, "draw_captioned", 7),
        (representation, "crop_features", 7),
        (denoiser, "denoising_loss", 17),
    ):
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
            die_after(patch, module, function, calls)
            stages.train("tiny", out, resume=True, progress=False)
    stages.train("tiny", out, resume=True, progress=False)
    assert same_weights(tiny_run, out)
    for name in ("losses_tmr.csv", "losses_vae.csv", "losses_dit.csv"):
        assert (tiny_run / name).read_text() == (out / name).read_text()
    before = (out / "dit.safetensors").read_bytes()
    stages.train("tiny", out, resume=True, progress=False)  # nothing left to do
    assert (out / "dit.safetensors").read_bytes() == before


def test_stage_by_stage_equals_all(tiny_run, tiny_preset, tiny_world, tmp_path):
    tiny_world(tiny_preset)
    out = tmp_path / "two"
    with pytest.raises(FileNotFoundError, match="stage dit needs the stages before it"):
        stages.train("tiny", out, stage="dit", progress=False)
    with pytest.raises(FileNotFoundError, match="tmr.safetensors"):
        stages.train("tiny", out, stage="vae", progress=False)
    stages.train("tiny", out, stage="tmr", progress=False)
    stages.train("tiny", out, stage="vae", progress=False)
    with pytest.raises(ValueError, match="stage dit"):
        checkpoints.load_checkpoint(out)
    stages.train("tiny", out, stage="dit", progress=False)
    assert same_weights(tiny_run, out)
    assert checkpoints.load_checkpoint(out).card["metrics"].keys() == {"val_r_at_1", "mpjpe_mm", "val_loss"}


def test_another_seed_is_another_model(tiny_run, tiny_preset, tiny_world, tmp_path):
    tiny_world(tiny_preset)
    stages.train("tiny", tmp_path / "a", stage="tmr", seed=1, progress=False)
    assert not same_weights(tiny_run, tmp_path / "a", ["tmr.safetensors"])


def test_runs_are_not_mixed(tiny_run, tiny_preset, tiny_world):
    tiny_world(tiny_preset)
    with pytest.raises(FileExistsError, match="--resume"):
        stages.train("tiny", tiny_run, progress=False)
    with pytest.raises(ValueError, match="another run .its seed"):
        stages.train("tiny", tiny_run, resume=True, seed=5, progress=False)
    with pytest.raises(ValueError, match="unknown stage"):
        stages.train("tiny", tiny_run, stage="gan", progress=False)
    with pytest.raises(FileExistsError, match="is a file"):
        stages.train("tiny", tiny_run / "card.json", progress=False)
    checkpoints.load_checkpoint(tiny_run)  # and it is as good as before


def test_ema_is_what_is_kept(tmp_path):
    class Line(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.zeros(()))

    models = nn.ModuleDict({"line": Line()})
    seen = []

    def loss(models, step, generator):
        seen.append(models["line"].weight.item())
        return (models["line"].weight - 1).square(), {}

    config = LoopConfig(steps=30, lr=0.1, warmup=1, ema=0.8)
    result = fit("line", models, loss, lambda ema: {}, config, tmp_path, identity={}, progress=False)
    average = 0.0
    for step, weight in enumerate([*seen[1:], models["line"].weight.item()]):
        decay = min(0.8, (1 + step) / (10 + step))
        average = decay * average + (1 - decay) * weight
    assert result.ema["line"].weight.item() == pytest.approx(average, rel=1e-5)
    assert (tmp_path / "losses_line.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_kill_minus_nine_leaves_a_whole_state(tmp_path):
    script = """
import sys, itertools, torch
from minicmdm.training.checkpoints import save_tensors
for step in itertools.count():
    save_tensors(sys.argv[1], {"a": torch.full((300, 300), step), "b": torch.full((300, 300), step)}, step)
"""
    state = tmp_path / "state.safetensors"
    process = subprocess.Popen([sys.executable, "-c", script, str(state)])
    while not state.exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.1)  # anywhere in one of the next writes
    process.send_signal(signal.SIGKILL)
    process.wait()
    tensors, step = checkpoints.load_tensors(state)
    assert (tensors["a"] == step).all() and (tensors["b"] == step).all()


def test_some_words_are_hidden_and_never_the_marks():
    mask = torch.arange(12) < torch.tensor([12, 7, 2, 3])[:, None]  # the third is "", the fourth has one word
    words = Words(torch.randn(4, 12, 3), mask)
    assert denoiser.hide_words(words, 0.0, torch.Generator()) is words
    hidden = torch.zeros(4, 12)
    for seed in range(400):
        seen = denoiser.hide_words(words, 0.25, torch.Generator().manual_seed(seed))
        assert seen.embeddings is words.embeddings and not (seen.mask & ~mask).any()
        hidden += (mask & ~seen.mask).float()
    for row, length in enumerate((12, 7, 2, 3)):
        assert hidden[row, 0] == hidden[row, length - 1] == 0 and not hidden[row, length:].any()
        inner = hidden[row, 1 : length - 1] / 400
        assert ((inner > 0.15) & (inner < 0.35)).all()
