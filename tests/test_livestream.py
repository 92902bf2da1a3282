"""The live stream: its chunks are the stream, its prompts are heard where it says, and its messages are answered."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from test_widgets import bundle, stand_in

from minicmdm.viz import livestream
from minicmdm.viz.livestream import CHUNK, LOW, OPENING, QUICK, Actor, LiveStream

WALK, JUMP = "a person walks", "a person jumps twice"


def plain(pipe, frames, prompt=WALK, says=(), **how):
    """The stream itself, told `says` = {frame: prompt} just before those frames are made."""
    stream, says, out = pipe.stream(prompt, **(QUICK | how)), dict(says), []
    for number in range(frames):
        if number in says:
            stream.prompt(says[number])
        out.append(next(stream))
    return np.stack(out)


class Page:
    """The browser's end: what the widget sends is kept, in order."""

    def __init__(self, pipe, **how):
        self.widget, self.heard = LiveStream(pipe, WALK, **how), []
        self.widget.send = lambda content, buffers=(): self.heard.append((content, buffers))

    def tell(self, **content):
        self.widget._handle_custom_msg(content, [])  # as ipywidgets does with a message
        return self.heard[-1]


def frames_of(buffer):
    return np.frombuffer(buffer, "<f4").reshape(-1, 22, 3)


# --- the actor --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cuts", [(20, 8, 8, 8), (1, 2, 3, 5, 8, 13), (44,)])
def test_chunks_continue_the_stream_exactly(tiny_pipe, cuts):
    actor = Actor(tiny_pipe, WALK)
    chunks = [actor.chunk(frames) for frames in cuts]
    assert [chunk.shape for chunk in chunks] == [(frames, 22, 3) for frames in cuts]
    np.testing.assert_array_equal(np.concatenate(chunks), plain(tiny_pipe, sum(cuts)))
    assert actor.number == sum(cuts) and chunks[0].dtype == "<f4"


@pytest.mark.parametrize("new_prompt", ["new", "active"])
def test_a_prompt_is_heard_from_the_frame_that_it_names(tiny_pipe, new_prompt):
    actor = Actor(tiny_pipe, WALK, new_prompt=new_prompt)
    before = actor.chunk(40)
    first = actor.say("  " + JUMP.replace(" ", "  "))
    after = actor.chunk(40)
    # K = 20 and L = 4: five latents are in flight, and the oldest has just been handed out.
    assert first == (56 if new_prompt == "new" else 40)
    assert [actor.acting(n) for n in (39, first - 1, first, 79)] == [WALK, WALK, JUMP, JUMP]
    told = plain(tiny_pipe, 80, says={40: JUMP}, new_prompt=new_prompt)
    np.testing.assert_array_equal(np.concatenate([before, after]), told)
    moved = np.abs(told - plain(tiny_pipe, 80, new_prompt=new_prompt)).max((1, 2))  # a tiny model hears little
    assert moved[:first].max() < 1e-6 < 1e-5 < moved[first:].max()


def test_the_last_word_counts_and_old_ones_are_forgotten(tiny_pipe):
    actor = Actor(tiny_pipe, WALK, new_prompt="new")
    actor.chunk(20)
    first = actor.say(JUMP)
    assert actor.say("a person sits down") == first and [told for _, told in actor.told] == [WALK, "a person sits down"]
    for _ in range(12):
        actor.chunk(20)
        actor.say(JUMP)
    assert len(actor.told) < 10 and actor.acting(actor.number - livestream.PAST) == JUMP


@pytest.mark.parametrize("prompt", ["", "   ", "\n", None, 7])
def test_an_empty_prompt_is_refused_in_one_clear_line_and_the_stream_goes_on(tiny_pipe, prompt):
    actor = Actor(tiny_pipe, WALK)
    before = actor.chunk(20)
    with pytest.raises(ValueError, match=r"^The prompt is empty: write what to do, .*send it\.$"):
        actor.say(prompt)
    np.testing.assert_array_equal(np.concatenate([before, actor.chunk(20)]), plain(tiny_pipe, 40))
    assert actor.told == [(0, WALK)]


# --- the widget -------------------------------------------------------------------------------------------------------


def test_the_first_second_is_made_at_once_and_chunks_follow_when_asked_for(tiny_pipe):
    page = Page(tiny_pipe)
    parts = [frames_of(page.widget.opening)]
    assert len(parts[0]) == OPENING >= LOW + CHUNK and page.heard == []  # nothing is made that nobody asked for
    for chunk in range(3):
        content, (buffer,) = page.tell(kind="more")
        assert content == {"kind": "frames", "first": OPENING + CHUNK * chunk, "told": [(0, WALK)]}
        parts.append(frames_of(buffer))
    np.testing.assert_array_equal(np.concatenate(parts), plain(tiny_pipe, OPENING + 3 * CHUNK))


def test_the_page_is_told_from_where_on_a_prompt_is_heard(tiny_pipe):
    page = Page(tiny_pipe)
    assert page.tell(kind="say", prompt=" " + JUMP)[0] == {"kind": "heard", "first": OPENING, "prompt": JUMP}
    assert page.tell(kind="more")[0]["told"] == [(0, WALK), (OPENING, JUMP)]


def test_what_cannot_be_read_is_said_on_the_page_and_nothing_stops(tiny_pipe):
    page = Page(tiny_pipe)
    for prompt, said in [("", "The prompt is empty"), ("walks " * 200, "too long"), (None, "The prompt is empty")]:
        content, _ = page.tell(kind="say", prompt=prompt)
        assert content["kind"] == "problem" and said in content["text"] and not content["fatal"]
        assert "\n" not in content["text"]
    assert page.tell(kind="more")[0]["kind"] == "frames" and len(page.heard) == 4
    page.tell(kind="nonsense")
    assert len(page.heard) == 4


def test_a_stream_that_breaks_says_so_and_stops(tiny_pipe, monkeypatch):
    page = Page(tiny_pipe)

    def broken(*_):
        raise RuntimeError("broken")

    monkeypatch.setattr(page.widget.actor, "chunk", broken)
    assert page.tell(kind="more")[0] == {"kind": "problem", "text": "RuntimeError: broken", "fatal": True}


def test_a_broken_widget_fails_the_notebook(tiny_pipe):
    for bad in (dict(prompt=""), dict(uncertainty=99), dict(schedule="trapezoid"), dict(new_prompt="none")):
        with pytest.raises(ValueError):
            LiveStream(tiny_pipe, **bad)


def test_there_is_a_picture_where_no_kernel_runs(tiny_pipe):
    widget = LiveStream(tiny_pipe, WALK)
    assert "application/vnd.jupyter.widget-view+json" in bundle(widget)
    assert 300 < stand_in(widget).width <= 1100 and len(bundle(widget)["image/png"]) < 90_000


# --- the script -------------------------------------------------------------------------------------------------------


def test_the_script_asks_only_the_kernel_and_keeps_its_keys():
    script = str(LiveStream._esm)
    assert not re.search(r"http|import |import\(|fetch\(|XMLHttp|WebSocket|setInterval", script)
    assert len(re.findall("^export default", script, re.M)) == 1 and "stopPropagation" in script
    assert "innerHTML" not in script  # a prompt can never become markup
    for hook in ("prompt", "send", "start", "said", "acting", "canvas"):
        assert f'"{hook}"' in script


@pytest.mark.skipif(shutil.which("node") is None, reason="node checks the script's syntax")
def test_the_script_is_a_module_that_a_browser_can_read(tmp_path):
    path = Path(tmp_path / "livestream.mjs")
    path.write_text(str(LiveStream._esm), encoding="utf-8")
    run = subprocess.run(["node", "--check", path], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
