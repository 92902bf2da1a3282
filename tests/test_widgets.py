"""The widgets: their plain functions, their callbacks and their static stand-ins. No browser here."""

import base64
import io
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from PIL import Image

from minicmdm.data.programs import Segment
from minicmdm.motion import Motion
from minicmdm.viz import widgets
from minicmdm.viz.widgets import MotionMaker, SkeletonPlayer, explore, in_words, make_motion

WALK = Segment("walk", speed="slow", start=0, end=50)
WAVE = Segment("wave", side="left", speed="normal", start=50, end=80)


def joints(frames=6, lift=0.0):
    return np.random.default_rng(frames).normal(size=(frames, 22, 3)) * 0.3 + [0, 1 + lift, 0]


def bundle(widget):
    """What a notebook stores of a widget: MIME type -> data."""
    out = widget._repr_mimebundle_()
    return out[0] if isinstance(out, tuple) else out


def stand_in(widget):
    return Image.open(io.BytesIO(base64.b64decode(bundle(widget)["image/png"])))


def block(value):
    return Image.new("RGB", (10, 10), (int(value) % 256, 0, 0))


# --- explore ----------------------------------------------------------------------------------------------------------


def test_explore_tries_every_end_before_anything_is_shown():
    seen = []

    def picture(**state):
        seen.append(state)
        return block(1)

    explorer = explore(picture, a=(0, 2, 9), b=(0.0, 0.5, 1.0), c=["x", "y", "z"], d=True, e="text")
    assert seen[0] == {"a": 2, "b": 0.5, "c": "x", "d": True, "e": "text"}
    tried = [{k: v for k, v in state.items() if v != seen[0][k]} for state in seen[1:]]
    assert tried == [{"a": 0}, {"a": 9}, {"b": 0.0}, {"b": 1.0}, {"c": "y"}, {"c": "z"}, {"d": False}]
    assert {name: widget.value for name, widget in explorer.inputs.items()} == seen[0]


@pytest.mark.parametrize("broken_at", [0, 2, 9])
def test_a_broken_callback_fails_at_once(broken_at):
    def picture(a):
        if a == broken_at:
            raise RuntimeError("broken")
        return block(a)

    with pytest.raises(RuntimeError, match="broken"):
        explore(picture, a=(0, 2, 9))


def test_a_slider_redraws_and_an_error_is_shown_where_the_reader_looks():
    def picture(a):
        if a == 5:
            raise RuntimeError("<five> is right out")
        return block(20 * a)

    explorer = explore(picture, a=(0, 2, 9))
    assert explorer.image.value == widgets.png(block(40))
    explorer.inputs["a"].value = 7
    assert explorer.image.value == widgets.png(block(140))
    explorer.inputs["a"].value = 5
    assert explorer.problem.value == "RuntimeError: &lt;five&gt; is right out"
    explorer.inputs["a"].value = 3
    assert explorer.problem.value == "" and explorer.image.value == widgets.png(block(60))
    assert stand_in(explorer).getpixel((5, 5)) == (60, 0, 0)


def test_sliders_are_whole_or_broken_like_their_numbers():
    inputs = explore(lambda a, b: block(a), a=(0, 2, 9), b=(0, 0.5, 1)).inputs
    assert type(inputs["a"]).__name__ == "IntSlider" and type(inputs["b"]).__name__ == "FloatSlider"
    assert (inputs["a"].min, inputs["a"].max, inputs["b"].min, inputs["b"].max) == (0, 9, 0, 1)
    assert not inputs["a"].continuous_update and inputs["b"].step == pytest.approx(0.01)


@pytest.mark.parametrize("control", [(1, 2), (3, 2, 9), [], None, 5])
def test_other_controls_are_refused(control):
    with pytest.raises(ValueError, match="size: a control is"):
        explore(lambda size: block(1), size=control)


def test_figures_become_small_pictures_and_are_closed():
    def picture(a):
        figure, _ = pyplot.subplots(figsize=(4, 3))
        return figure

    explorer = explore(picture, a=(0, 1, 2))
    assert stand_in(explorer).size == (320, 240) and pyplot.get_fignums() == []
    assert Image.open(io.BytesIO(widgets.png(Figure(figsize=(2, 1))))).size == (160, 80)
    with pytest.raises(ValueError, match="figure or an image, and NoneType"):
        explore(lambda a: None, a=(0, 1, 2))


# --- the player -------------------------------------------------------------------------------------------------------


def test_player_packs_the_motions_and_shows_others_when_told():
    player = SkeletonPlayer([joints(6), joints(9)], ["one", "two"], fps=10)
    assert [(clip["caption"], clip["frames"]) for clip in player.data["clips"]] == [("one", 6), ("two", 9)]
    assert player.data["fps"] == 10 and json.dumps(player.data)
    clip = player.data["clips"][1]
    numbers = np.frombuffer(base64.b64decode(clip["joints"]), "<i2").reshape(-1, 22, 3) * clip["scale"]
    np.testing.assert_allclose(numbers, joints(9), atol=1e-4)
    told = []
    player.observe(told.append, "data")
    player.play([joints(4)], ["three"])
    assert len(told) == 1 and player.data["clips"][0]["frames"] == 4
    with pytest.raises(ValueError, match="1 motions, 2 captions"):
        player.play([joints(4)], ["a", "b"])


def test_player_has_a_picture_for_readers_without_a_kernel():
    one, two = SkeletonPlayer([joints()], ["one"]), SkeletonPlayer([joints(), joints(lift=0.3)], ["one", "two"])
    assert "application/vnd.jupyter.widget-view+json" in bundle(one)
    assert stand_in(two).height == 2 * stand_in(one).height and stand_in(one).width <= 1100
    assert len(bundle(one)["image/png"]) < 60_000
    one.play([joints(lift=0.3)], ["two"])
    below = np.asarray(stand_in(two))[stand_in(one).height :]
    assert np.array_equal(np.asarray(stand_in(one)), below)


def test_player_shows_noise_as_colour_and_so_does_its_picture():
    levels = np.linspace(0, 1, 6)
    clean, noisy = (
        SkeletonPlayer([joints()] * 2, ["a", "b"]),
        SkeletonPlayer([joints()] * 2, ["a", "b"], noise=[None, levels]),
    )
    assert [clip["noise"] is None for clip in noisy.data["clips"]] == [True, False]
    top, below = stand_in(clean).height // 2, stand_in(noisy)
    assert below.height == stand_in(clean).height + 14
    assert np.array_equal(np.asarray(below)[:top], np.asarray(stand_in(clean))[:top])
    noisy.play([joints(4)], ["c"])
    assert noisy.data["clips"][0]["noise"] is None and stand_in(noisy).height == top
    with pytest.raises(ValueError, match="noise must be 4 numbers"):
        noisy.play([joints(4)], ["c"], noise=[levels])


def test_script_needs_no_network():
    script = SkeletonPlayer._esm
    script = script if isinstance(script, str) else str(script)
    assert not re.search(r"http|import |import\(|fetch\(|XMLHttp|WebSocket", script)
    assert len(re.findall("^export default", script, re.M)) == 1 and "minicmdmPlayer(root" in script


@pytest.mark.skipif(shutil.which("node") is None, reason="node checks the script's syntax")
def test_script_is_a_module_that_a_browser_can_read(tmp_path):
    (tmp_path / "player.mjs").write_text(str(SkeletonPlayer._esm), encoding="utf-8")
    run = subprocess.run(["node", "--check", tmp_path / "player.mjs"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


# --- notebook 00: sentence, length, seed ------------------------------------------------------------------------------


class FakePipe:
    """Answers with a motion that lasts as long as asked, and remembers what it was asked."""

    def __init__(self, broken_at=None):
        self.asked, self.broken_at = [], broken_at

    def __call__(self, prompt, num_frames, seed):
        self.asked.append((prompt, num_frames, seed))
        if not prompt.strip():
            raise ValueError("the prompt is empty")
        if num_frames == self.broken_at or prompt == "crash":
            raise RuntimeError("broken")
        return Motion(np.zeros((num_frames, 22, 3), np.float32), caption=prompt)


@pytest.fixture
def read(monkeypatch):
    monkeypatch.setattr(widgets, "read_motion", lambda joints: [WALK, WAVE])


def test_segments_in_words():
    assert in_words([WALK, WAVE]) == "walk (speed slow), 0.0-2.5 s; wave (side left, speed normal), 2.5-4.0 s"
    assert in_words([Segment("stand", start=0, end=4)]) == "stand, 0.0-0.2 s" and in_words([]) == ""
    assert in_words([Segment("jump", count=2, start=0, end=4)]) == "jump (count 2), 0.0-0.2 s"


def test_making_a_motion_answers_or_says_why_not(read):
    motion, said = make_motion(FakePipe(), "a person walks", 40, 3)
    assert len(motion) == 40 and said.startswith("The oracle reads: walk (speed slow), 0.0-2.5 s; wave")
    assert make_motion(FakePipe(), "  ", 40, 3) == (None, "the prompt is empty")


def test_maker_tries_the_shortest_and_the_longest_before_it_is_shown(read):
    pipe = FakePipe()
    maker = MotionMaker(pipe, "a person walks", 80, seed=5)
    assert sorted(pipe.asked) == [("a person walks", frames, 5) for frames in (40, 80, 196)]
    assert maker.player.data["clips"][0]["frames"] == 80 and maker.said.value.startswith("The oracle reads")
    assert stand_in(maker).width > 100
    for frames in (40, 80, 196):
        with pytest.raises(RuntimeError, match="broken"):
            MotionMaker(FakePipe(broken_at=frames), "a person walks", 80)
    with pytest.raises(ValueError, match="prompt is empty"):
        MotionMaker(pipe, "")


def test_the_button_makes_what_the_controls_say(read):
    pipe = FakePipe()
    maker = MotionMaker(pipe)
    maker.prompt.value, maker.frames.value, maker.seed.value = "a person jumps", 44, 9
    maker.button.click()
    assert pipe.asked[-1] == ("a person jumps", 44, 9) and not maker.button.disabled
    assert maker.player.data["clips"][0]["caption"] == "a person jumps"
    before = maker.player.data
    for prompt, said in [("", "the prompt is empty"), ("crash", "RuntimeError: broken")]:
        maker.prompt.value = prompt
        maker.button.click()
        assert maker.said.value == said and maker.player.data == before and not maker.button.disabled


def test_motion_shows_itself_with_the_player_in_a_notebook(monkeypatch):
    from minicmdm import motion as module

    monkeypatch.setattr(module, "_in_notebook", lambda: True)
    one = Motion(joints(), caption="walks", fps=25)
    player = one.show()
    assert isinstance(player, SkeletonPlayer) and player.data["fps"] == 25
    assert player.data["clips"][0]["caption"] == "walks"
    monkeypatch.setitem(__import__("sys").modules, "minicmdm.viz.widgets", None)  # as if the extra were missing
    assert "srcdoc" in one.show().data
