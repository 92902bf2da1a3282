"""The noise painter: what it computes, its picture, its callbacks, and its script as far as Python and node can see."""

import base64
import copy
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from minicmdm.diffusion.forcing import diffusion_forcing_loss
from minicmdm.viz import painter
from minicmdm.viz.painter import NUM_LEVELS, SERIES, Canvas, NoisePainter, picture, presets


@pytest.fixture
def canvas(tiny_pipe):
    features = np.random.default_rng(0).normal(size=(32, 263)).astype(np.float32) * 0.1
    pipe = copy.deepcopy(tiny_pipe)  # others use it too
    torch.nn.init.normal_(pipe.dit.out.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    return Canvas(pipe, features, "a person walks", seed=1)


def test_clean_latents_are_the_motion_and_their_guess_is_exact(canvas):
    clean = canvas.paint([0] * 8)
    assert clean.noisy.shape == clean.guess.shape == canvas.truth.shape == (32, 22, 3)
    np.testing.assert_allclose(clean.noisy, canvas.truth, atol=1e-5)
    np.testing.assert_allclose(clean.guess, canvas.truth, atol=1e-5)
    assert clean.off.max() < 1e-3 and clean.loss.min() > 0  # nothing to do, and yet the noise cannot be known
    assert not clean.noise.any() and (canvas.paint([NUM_LEVELS] * 8).noise == 1).all()


def test_noise_alone_tells_nothing_of_the_motion(canvas):
    other = Canvas(canvas._pipe, np.ones((32, 263), np.float32), "a person walks", seed=1)
    one, two = (c.paint([NUM_LEVELS] * 8) for c in (canvas, other))
    np.testing.assert_allclose(one.noisy, two.noisy, atol=1e-5)
    assert np.abs(one.loss - two.loss).max() > 1e-3


def test_a_level_moves_no_frame_before_its_latent(canvas):
    one = canvas.paint([5] * 8)
    two = canvas.paint([5] * 5 + [NUM_LEVELS] + [5] * 2)
    for name in ("noisy", "guess"):
        moved = np.abs(getattr(one, name) - getattr(two, name)).max((1, 2))
        assert moved[:20].max() < 1e-4 < moved[20:].max()
    np.testing.assert_allclose(one.loss[:5], two.loss[:5], atol=1e-5)
    assert two.noise.tolist() == [0.25] * 20 + [1.0] * 4 + [0.25] * 8


def test_the_losses_are_those_of_training(canvas):
    levels = [0, 3, 20, 7, 11, 1, 16, 9]
    t = 1 - torch.tensor([levels]) / NUM_LEVELS
    generator = torch.Generator().manual_seed(1)  # the seed of the canvas, so that the library draws the same noise

    def model(z_t, t, *_):
        return canvas.denoise(z_t, t)

    with torch.no_grad():
        training = diffusion_forcing_loss(model, canvas.z, None, None, generator=generator, t=t)
    assert canvas.paint(levels).loss.mean() == pytest.approx(training.item(), rel=1e-4)


@pytest.mark.parametrize("levels", [[0] * 7, [0] * 9, [21] + [0] * 7, [-1] + [0] * 7, [0.5] * 8, []])
def test_other_levels_are_refused(canvas, levels):
    with pytest.raises(ValueError, match="expected 8 whole numbers from 0 to 20"):
        canvas.paint(levels)


@pytest.mark.parametrize("count", [4, 8, 24, 49])
def test_presets_are_levels_for_any_length(count):
    rows = presets(count)
    assert all(len(row) == count and 0 <= min(row) <= max(row) <= NUM_LEVELS for row in rows.values())
    assert set(rows["all noise"]) == {NUM_LEVELS} and set(rows["all clean"]) == {0}
    assert rows["FSS row"] == sorted(rows["FSS row"]) and len(set(rows["one level"])) == 1
    assert json.loads(json.dumps(rows)) == rows


def test_picture_shows_every_state(canvas):
    seen = [np.asarray(picture(canvas, canvas.paint(levels))) for levels in ([0] * 8, [NUM_LEVELS] * 8, [9] * 8)]
    assert len({image.tobytes() for image in seen}) == 3 and len({image.shape for image in seen}) == 1
    assert seen[0].shape[1] <= 1100


def test_a_broken_state_fails_before_anything_is_shown(canvas, monkeypatch):
    paint = Canvas.paint
    for broken in ([0] * 8, [NUM_LEVELS] * 8):

        def fails(self, levels, broken=broken):
            if list(levels) == broken:
                raise RuntimeError("broken")
            return paint(self, levels)

        monkeypatch.setattr(Canvas, "paint", fails)
        with pytest.raises(RuntimeError, match="broken"):
            NoisePainter(canvas)


def test_painting_answers_with_numbers_and_motions(canvas, monkeypatch):
    widget = NoisePainter(canvas)
    assert widget.levels == presets(8)["training draw"] == widget.shown["levels"]
    answers = []
    widget.observe(lambda change: answers.append(change.new), "shown")
    widget.levels = [4] * 8
    (answer,) = answers
    assert answer["levels"] == [4] * 8 and answer["problem"] == "" and json.dumps(answer)
    assert set(answer["values"]) == {name for name, *_ in SERIES}
    np.testing.assert_allclose(answer["values"]["loss"], canvas.paint([4] * 8).loss, atol=1e-3)
    clips = answer["motions"]["clips"]
    assert [clip["frames"] for clip in clips] == [32] * 3 and clips[0]["noise"] is None
    assert set(base64.b64decode(clips[1]["noise"])) == {51}  # a fifth of 255
    widget.levels = [99] * 8  # what no bar can ask for is still answered, where the reader looks
    assert widget.shown["problem"].startswith("ValueError: expected 8") and widget.shown["levels"] == [99] * 8
    widget.levels = [0] * 8
    assert widget.shown["problem"] == ""


def test_painter_has_a_picture_for_readers_without_a_kernel(canvas):
    data, _ = NoisePainter(canvas, [3] * 8)._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in data
    image = Image.open(io.BytesIO(base64.b64decode(data["image/png"])))
    assert np.array_equal(np.asarray(image), np.asarray(picture(canvas, canvas.paint([3] * 8))))


def test_script_needs_no_network_and_names_its_hooks():
    script = str(NoisePainter._esm)
    assert not re.search(r"http|import |import\(|fetch\(|XMLHttp|WebSocket", script)
    assert len(re.findall("^export default", script, re.M)) == 1 and "minicmdmPlayer(stage" in script
    for hook in ("painter-level", "painter-preset", "painter-value", "painter-problem", "painter-player"):
        assert f'"{hook}"' in script
    assert {name for name, *_ in SERIES} == set(
        re.search(r"TALL = \{(.*?)\}", script)[1].replace(":", " ").split()[::2]
    )


@pytest.mark.skipif(shutil.which("node") is None, reason="node checks the script's syntax")
def test_script_is_a_module_that_a_browser_can_read(tmp_path):
    (tmp_path / "painter.mjs").write_text(str(NoisePainter._esm), encoding="utf-8")
    run = subprocess.run(["node", "--check", tmp_path / "painter.mjs"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_it_is_as_short_as_an_essay():
    assert len(open(painter.__file__, encoding="utf-8").read().splitlines()) < 200
