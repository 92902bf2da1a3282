"""The matrix explorer: its numbers, its film, its picture, and the widget over them. No browser here."""

import asyncio
import base64
import io
import re
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from PIL import Image

from minicmdm.data.features import features_to_joints
from minicmdm.diffusion.schedules import closed_form_cost, schedule_matrix
from minicmdm.viz import matrix as mx
from minicmdm.viz.matrix import CONTROLS, LITERAL, Film, MatrixExplorer, look, picture

DEFAULT = dict(kind="fss", num_steps=12, uncertainty=3, num_latents=12, block_size=1)


def fake_film(matrix):
    return np.full((*matrix.shape, 22, 2), 1000, "<i2")


def facts(**state):
    return [value for _, value in look(**(DEFAULT | state)).facts]


# --- numbers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "wanted"),
    [
        ({}, ["46", "45", "4", "12", "3"]),
        ({"uncertainty": 0}, ["13", "12", "12", "12", "0"]),
        ({"uncertainty": 12}, ["145", "144", "1", "12", "12"]),
        ({"kind": "autoregressive"}, ["145", "144", "1", "12", "12"]),
        ({"kind": "full"}, ["13", "12", "12", "12", "0"]),
        ({"block_size": 3}, ["22", "21", "12", "12", "1"]),
        ({"kind": LITERAL}, ["16", "15", "4", "4", "1"]),
        ({"kind": "trapezoid"}, ["28", "27", "8", "12", "1.5"]),
    ],
)
def test_the_five_numbers(state, wanted):
    assert facts(**state) == wanted


@pytest.mark.parametrize("kind", ["fss", "full", "autoregressive", "triangular", "trapezoid"])
def test_the_numbers_are_the_cost_formulas(kind):
    for steps, stagger, count, block in [(1, 0, 4, 1), (12, 5, 16, 4), (20, 2, 7, 3)]:
        price = closed_form_cost(count, steps, stagger, block, kind)
        shown = look(kind, steps, stagger, count, block)
        assert [int(v) for _, v in shown.facts[:4]] == [
            price.rows,
            price.calls,
            price.latents_in_flight,
            price.calls_to_first,
        ]
        np.testing.assert_array_equal(shown.matrix, schedule_matrix(count, steps, stagger, block, kind))


def test_a_row_in_words():
    seen = look(**DEFAULT)
    assert seen.line(0).startswith("row m = 0 of 45: 0 latents clean, 0 between, 12 still pure noise. 0 frames, 0.0 s")
    assert "5 latents clean, 3 between, 4 still pure noise. 20 frames, 1.0 s" in seen.line(24)
    assert "12 latents clean, 0 between, 0 still pure noise. 48 frames, 2.4 s" in seen.line(45)
    both_ends = look(**(DEFAULT | {"kind": "trapezoid"}))
    assert "2 latents clean" in both_ends.line(12) and "4 frames" in both_ends.line(12)  # a stream shows the left alone


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"num_steps": 2}, "L = 3 is more than K = 2"),
        ({"uncertainty": 20, "kind": "trapezoid"}, "more than"),
        ({"kind": LITERAL, "uncertainty": 0}, "L = 0 is no stagger here"),
        ({"kind": LITERAL, "uncertainty": 20}, "more than"),
    ],
)
def test_what_is_no_schedule_is_a_line_and_no_exception(state, said):
    seen = look(**(DEFAULT | state))
    assert said in seen.problem and seen.facts == [] and seen.matrix.shape == (0, 12)
    assert "\n" not in seen.problem and len(seen.problem) < 120
    assert np.unique(np.asarray(picture(seen, 0))).size > 2  # the line is on the picture


def test_full_and_autoregressive_ask_for_no_stagger():
    assert look(**(DEFAULT | {"kind": "full", "uncertainty": 20})).problem == ""


# --- film and picture -------------------------------------------------------------------------------------------------


def test_the_film_holds_every_row_and_ends_with_the_pipelines_motion(tiny_pipe):
    film = Film(tiny_pipe, "a person walks", seed=3)
    matrix = schedule_matrix(4, 6, 2)
    assert not film.known(matrix)
    poses = film(matrix)
    assert poses.shape == (len(matrix), 4, 22, 2) and poses.dtype == np.int16
    motion = tiny_pipe("a person walks", 16, num_steps=6, uncertainty=2, seed=3, tell_length=False)
    ends = motion.joints[3::4] - motion.joints[3::4, :1] * [1, 0, 1]
    np.testing.assert_allclose(poses[-1] / 1000, (ends @ mx.plots._CAMERA.T)[..., :2], atol=2e-3)
    noise = tiny_pipe._noise(torch.Generator().manual_seed(3), 4)[None]
    first = features_to_joints(tiny_pipe.decode(noise)[0].numpy())[3::4]
    np.testing.assert_allclose(
        poses[0, :, 0, 1] / 1000, (first[:, 0] * [0, 1, 0] @ mx.plots._CAMERA.T)[:, 1], atol=2e-3
    )


def test_what_is_final_stays_on_the_film_and_a_schedule_is_sampled_once(tiny_pipe, monkeypatch):
    film, matrix = Film(tiny_pipe, "a person walks"), schedule_matrix(5, 4, 2)
    poses = film(matrix)
    for n in range(5):
        done = int((matrix[:, n] > 0).sum())
        assert np.abs(poses[done:, n].astype(int) - poses[-1, n]).max() <= 1
    monkeypatch.setattr(tiny_pipe, "decode", None)
    assert film.known(matrix.copy()) and film(matrix.copy()) is poses
    assert not film.known(matrix[:, :4])


def test_more_latents_only_add_to_the_right(tiny_pipe):
    film = Film(tiny_pipe, "a person walks")
    short, long = film(schedule_matrix(4, 5, 2)), film(schedule_matrix(7, 5, 2))
    assert np.abs(long[: len(short), :4].astype(int) - short).max() <= 1


def test_the_picture_shows_the_cursor_the_bars_and_the_fading_poses():
    seen = look(**DEFAULT)
    pictures = {row: np.asarray(picture(seen, row, fake_film(seen.matrix))).astype(int) for row in (0, 24, 45)}
    heat = slice(mx.TOP, mx.TOP + mx.HEIGHT)
    for row, shown in pictures.items():
        dark = (shown[heat, mx.LEFT - 3] < 80).all(-1).nonzero()[0]  # the cursor's left edge
        assert abs(dark.mean() - mx.HEIGHT * (row + 0.5) / 46) < 3
    bars = slice(mx.TOP + mx.HEIGHT + 6, mx.TOP + mx.HEIGHT + mx.BARS + 6)
    noisy = [int((shown[bars] == mx.NOISY).all(-1).sum()) for shown in pictures.values()]
    assert noisy[0] > noisy[1] > noisy[2] == 0
    assert picture(seen, 24, None).size == picture(seen, 24, fake_film(seen.matrix)).size and mx.WIDTH <= 1100
    colours = look(**DEFAULT).colours
    assert tuple(colours[0]) == mx.CLEAN and tuple(colours[-1]) == mx.NOISY and tuple(colours[6]) == mx.HALF
    assert (np.diff(colours.sum(1, dtype=int)) < 0).all()  # also in grey: more noise is darker


# --- the widget -------------------------------------------------------------------------------------------------------


def test_every_end_of_every_control_is_tried_before_anything_is_shown():
    asked = []
    MatrixExplorer(lambda matrix: asked.append((int(matrix[0, 0]), matrix.shape)) or fake_film(matrix))
    sizes = {(steps, *shape) for steps, shape in asked}
    assert {(12, 46, 12), (20, 54, 12), (12, 13, 12), (12, 22, 4), (12, 58, 16), (12, 145, 12)} <= sizes
    assert (1, 2, 12) not in sizes  # L = 3 is more than K = 1: no film, no error
    for broken in (13, 145, 22):  # rows of an end that fails

        def film(matrix, broken=broken):
            if len(matrix) == broken:
                raise RuntimeError("broken")
            return fake_film(matrix)

        with pytest.raises(RuntimeError, match="broken"):
            MatrixExplorer(film)


def known(film):
    film.known = lambda matrix: True
    return film


@pytest.fixture
def explorer():
    return MatrixExplorer(known(lambda matrix: fake_film(matrix)))


def test_a_control_changes_what_the_browser_gets(explorer):
    assert explorer.row.value == explorer.canvas.row == 24 and explorer.row.max == 45
    explorer.inputs["uncertainty"].value = 0
    data = explorer.canvas.data
    assert (data["rows"], data["latents"], data["steps"], data["waits"], data["problem"]) == (13, 12, 12, False, "")
    assert explorer.row.max == explorer.row.value == explorer.canvas.row == explorer.clock.max == 12
    levels = np.frombuffer(data["levels"], np.uint8).reshape(13, 12)
    np.testing.assert_array_equal(levels, schedule_matrix(12, 12, 0))
    assert np.frombuffer(data["poses"], "<i2").shape == (13 * 12 * 44,)
    assert np.frombuffer(data["colours"], np.uint8).shape == (13 * 3,)
    assert len(data["lines"]) == 13 and len(data["bones"]) == 21 and data["facts"][1] == ("calls", "12")
    explorer.inputs["num_steps"].value = 20
    explorer.inputs["uncertainty"].value = 20
    explorer.inputs["num_latents"].value = 16
    assert explorer.canvas.data["rows"] == 321 and len(explorer.canvas.data["poses"]) < 500_000


def test_an_impossible_state_is_said_and_left_again(explorer):
    explorer.inputs["num_steps"].value = 1
    assert "L = 3 is more than K = 1" in explorer.canvas.data["problem"] and explorer.canvas.data["rows"] == 0
    assert explorer.row.value == 24 and explorer.picture().size[0] == mx.WIDTH  # the cursor stays where it was
    explorer.inputs["uncertainty"].value = 1
    assert explorer.canvas.data["problem"] == "" and explorer.row.max == 12
    explorer.inputs["uncertainty"].value = 3
    explorer.inputs["num_steps"].value = 12
    assert explorer.row.max == 45 and explorer.row.value == 12


def test_a_film_that_comes_too_late_is_not_shown(explorer):
    def slow(matrix):
        explorer._film = known(lambda matrix: fake_film(matrix))
        explorer.inputs["uncertainty"].value = 6  # as another thread does while this one samples
        return fake_film(matrix)

    explorer._film = known(slow)
    explorer.inputs["uncertainty"].value = 5
    assert explorer.canvas.data["rows"] == 79 == len(explorer.poses) == len(explorer.seen.matrix)


def run(work):
    """Run a coroutine in a thread of its own: in this one a browser's loop may be running."""
    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, work).result()


def test_a_new_schedule_shows_at_once_and_its_film_when_the_controls_rest(monkeypatch):
    monkeypatch.setattr(mx, "PAUSE", 0.02)
    made = []
    film = lambda matrix: made.append(len(matrix)) or fake_film(matrix)  # noqa: E731
    film.known = lambda matrix: len(matrix) in made
    explorer, seen = MatrixExplorer(film), []
    made.clear()
    explorer.canvas.observe(lambda change: seen.append((change.new["rows"], change.new["waits"])), "data")

    async def drag():
        for stagger in (4, 5, 6):
            explorer.inputs["uncertainty"].value = stagger
        assert made == [] and explorer.canvas.data["poses"] == b""
        await asyncio.sleep(0.2)

    run(drag())
    assert seen == [(57, True), (68, True), (79, True), (79, False)] and made == [79]
    run(drag_back(explorer))
    assert seen[4:] == [(68, True), (79, False)]  # a film that is known comes with its schedule


async def drag_back(explorer):
    explorer.inputs["uncertainty"].value = 5
    explorer.inputs["uncertainty"].value = 6
    assert len(explorer.canvas.data["poses"]) > 0
    await asyncio.sleep(0.1)


def test_an_error_of_the_film_is_shown_where_the_reader_looks(explorer):
    explorer._film = known(lambda matrix: 1 / 0)
    explorer.inputs["uncertainty"].value = 5
    assert explorer.canvas.data["problem"] == "ZeroDivisionError: division by zero" and explorer.poses is None


def test_without_a_film_there_is_the_matrix():
    explorer = MatrixExplorer()
    assert explorer.canvas.data["poses"] == b"" and not explorer.canvas.data["waits"]


def test_a_picture_stands_in_where_no_kernel_runs(explorer):
    bundle = explorer._repr_mimebundle_()
    shown = Image.open(io.BytesIO(base64.b64decode(bundle["image/png"])))
    assert shown.size == explorer.picture().size and len(bundle["image/png"]) < 40_000
    assert "application/vnd.jupyter.widget-view+json" in bundle


def test_a_browser_test_finds_its_hooks(explorer):
    for name in CONTROLS:
        assert f"fss-{name.replace('_', '-')}" in explorer.inputs[name]._dom_classes
    assert "fss-row" in explorer.row._dom_classes
    script = str(explorer.canvas._esm)
    for hook in ("fss-matrix", "fss-facts", "fss-problem", "fss-line", "dataset.row", "dataset.facts", "dataset.poses"):
        assert hook in script


def test_the_script_needs_no_network_and_is_a_module(tmp_path):
    script = str(MatrixExplorer().canvas._esm)
    assert not re.search(r"http|import |import\(|fetch\(|XMLHttp|WebSocket", script)
    assert len(re.findall("^export default", script, re.M)) == 1
    if shutil.which("node"):
        (tmp_path / "matrix.mjs").write_text(script, encoding="utf-8")
        run = subprocess.run(["node", "--check", tmp_path / "matrix.mjs"], capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
