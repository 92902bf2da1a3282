"""The notebooks' widgets in JupyterLab, as a student meets them: every cell is run, hands are laid on the widgets.

The harness is tested first, on a notebook made here: it moves what can be moved, and it hears what goes wrong.
"""

import re
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
SMALL = {
    "small": """
import numpy as np
from PIL import Image
from minicmdm.viz.widgets import SkeletonPlayer, explore

def tile(size, word="x", broken=False):
    if broken and size > 3:
        raise ValueError("this one is broken")
    return Image.new("RGB", (40 * size, 80), (40 * len(word) % 256, 90, 200))
""",
    "player": """
joints = np.random.default_rng(0).normal(size=(30, 22, 3)) * 0.3 + [0, 1, 0]
joints[:, 10:12, 1] = 0.02  # the feet on the floor
SkeletonPlayer([joints, joints[::-1]], ["one", "two"], noise=[None, np.linspace(0, 1, 30)])
""",
    "explorer": "explore(tile, size=(1, 3, 9), word=['red', 'green'])",
    "broken": """
explorer = explore(tile, size=(1, 2, 3), broken=True)
explorer.inputs["size"].max = 9  # beyond what was tried
explorer
""",
    "loud": """
import ipywidgets
button = ipywidgets.Button(description="loud")
button.on_click(lambda _: 1 / 0)
button
""",
}


def changes(place, act, patience: float = 60) -> None:
    """Do `act` and wait until the picture in `place` (an image's address, a canvas's pixels) is another one."""
    read = "(e) => e.tagName === 'CANVAS' ? e.toDataURL() : e.src"  # of whatever stands there now
    before, end = place.evaluate(read), time.monotonic() + patience
    act()
    while place.evaluate(read) == before:
        assert time.monotonic() < end, f"the picture in {place} did not change"
        place.page.wait_for_timeout(50)


def press(slider, key: str):
    """Move an ipywidgets slider by a key."""

    def act():
        slider.locator(".noUi-handle").focus()
        slider.page.keyboard.press(key)

    return act


def slider(cell, name: str):
    """The ipywidgets slider with this label in a cell."""
    return cell.locator(".widget-slider").filter(has_text=re.compile(rf"^\s*{re.escape(name)}"))


def test_the_harness_moves_sliders_and_players_and_hears_what_fails(open_notebook, shots):
    notebook = open_notebook(SMALL).run()
    page = notebook.page

    cell = notebook.cell("player")
    root, canvas = cell.locator("[data-frame]"), cell.locator("figure canvas").first
    assert root.get_attribute("data-frame") == "0"  # this page asked for reduced motion, so nothing plays by itself
    changes(canvas, lambda: cell.get_by_label("Frame").press("ArrowRight"))  # and JupyterLab did not take the key
    assert root.get_attribute("data-frame") == "1"
    root.focus()
    changes(canvas, lambda: page.keyboard.press("ArrowRight"))
    changes(canvas, lambda: cell.get_by_label("contacts").uncheck())
    for key in "dd":  # would delete the cell
        page.keyboard.press(key)
    notebook.shoot(cell.locator("[data-frame]"), shots / "lab-player.png")

    cell = notebook.cell("explorer")
    image = cell.locator("img.widget-image")
    changes(image, press(slider(cell, "size"), "ArrowRight"))
    changes(image, lambda: cell.get_by_role("combobox").select_option("green"))
    notebook.check()

    cell = notebook.cell("broken")
    press(slider(cell, "size"), "End")()
    cell.get_by_text("ValueError: this one is broken").wait_for()
    notebook.check()  # shown where the reader looks, and no error of the kernel

    notebook.cell("loud").get_by_role("button", name="loud").click()
    page.wait_for_function("window.kernelProblems.length > 0")
    with pytest.raises(AssertionError, match="ZeroDivisionError"):
        notebook.check()


def test_the_harness_hears_a_cell_that_fails_and_a_request_that_leaves(open_notebook, tab):
    notebook = open_notebook({"fails": "1 / 0"})
    with pytest.raises(AssertionError, match="ZeroDivisionError"):
        notebook.run()
    page, outside, _ = tab
    page.evaluate("fetch('https://example.org/x.js').catch(() => null)")
    assert outside == ["https://example.org/x.js"]
    outside.clear()  # or this very test would fail


# --- the three bold widgets -------------------------------------------------------------------------------------------


def test_06_a_level_painted_by_hand_changes_motion_guess_and_loss(open_notebook, shots):
    notebook = open_notebook(NOTEBOOKS / "06_diffusion_forcing.ipynb", last="painter").run()  # what follows trains
    page = notebook.page
    root = page.locator(".painter")
    root.scroll_into_view_if_needed()
    area, noised, guess = root.locator(".painter-area"), *root.locator("figure canvas").all()[1:]

    def answered():
        page.wait_for_function("document.querySelector('.painter').dataset.busy === 'no'")
        assert root.locator(".painter-problem").inner_text() == ""
        return root.get_attribute("data-levels").split(",")

    def losses():
        return root.locator(".painter-value[data-series=loss]").evaluate_all("(all) => all.map((e) => e.dataset.value)")

    def stroke():  # over the left half, low: nearly clean
        box = area.bounding_box()
        page.mouse.move(box["x"] + 3, box["y"] + 0.9 * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 0.9 * box["height"], steps=3)
        page.mouse.up()

    before, lost = answered(), losses()
    changes(noised, stroke)
    painted = answered()
    half = len(painted) // 2
    assert painted[: half - 1] == ["2"] * (half - 1) and painted[half + 2 :] == before[half + 2 :]
    assert losses() != lost
    notebook.shoot(root, shots / "06-painter.png")
    changes(guess, lambda: root.locator("[data-preset='all noise']").click())
    assert len(set(answered())) == 1
    changes(guess, lambda: root.get_by_label("Frame").press("End"))  # in frame 0 latent 3 could change nothing
    root.locator(".painter-level").nth(3).focus()
    changes(noised, lambda: page.keyboard.press("PageDown"))  # and JupyterLab did not take the key
    assert answered()[3] != answered()[4]
    notebook.check()


def test_08_every_slider_changes_the_matrix_and_its_poses(open_notebook, shots):
    notebook = open_notebook(NOTEBOOKS / "08_schedule_matrix.ipynb").run()
    page = notebook.page
    root, canvas = page.locator(".fss-matrix"), page.locator(".fss-matrix canvas")
    root.scroll_into_view_if_needed()

    def settled():
        page.wait_for_function("document.querySelector('.fss-matrix').dataset.poses !== 'waits'")
        return root.evaluate("(e) => ({...e.dataset})")

    start = settled()
    assert start["poses"] == "yes"
    changes(canvas, press(page.locator(".fss-row"), "ArrowRight"))
    assert int(settled()["row"]) == int(start["row"]) + 1
    notebook.shoot(root, shots / "08-matrix.png")
    for name in ("num-steps", "uncertainty", "num-latents", "block-size"):
        before = settled()
        changes(canvas, press(page.locator(f".fss-{name}"), "ArrowRight"))
        after = settled()
        assert after["facts"] != before["facts"] and after["poses"] == "yes", name
    facts = settled()["facts"]
    changes(canvas, lambda: page.locator(".fss-kind select").select_option("autoregressive"))
    assert settled()["facts"] != facts
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 20)
    changes(canvas, page.mouse.down)
    row = int(root.get_attribute("data-row"))
    page.mouse.move(box["x"] + 200, box["y"] + 90, steps=3)
    page.mouse.up()
    assert int(root.get_attribute("data-row")) > row
    page.locator(".fss-kind select").select_option("fss")
    press(page.locator(".fss-uncertainty"), "End")()  # L = 20 is more than K
    page.locator(".fss-problem").get_by_text("is more than K").wait_for()
    notebook.check()


def test_09_a_prompt_typed_while_it_moves_changes_its_mind(open_notebook, shots):
    notebook = open_notebook(NOTEBOOKS / "09_sampling_and_streaming.ipynb").run()
    page = notebook.page
    root, canvas = page.locator(".livestream"), page.locator(".livestream-canvas")
    root.scroll_into_view_if_needed()

    def until(what: str):
        page.wait_for_function(f"((d) => {what})(document.querySelector('.livestream').dataset)", timeout=60_000)

    assert root.get_attribute("data-playing") == "no"
    changes(canvas, root.locator(".livestream-start").click)
    until("Number(d.frame) > 30")  # more than it was born with: the kernel makes them while it plays
    box = root.locator(".livestream-prompt")
    box.fill("a person jumps twice")
    at = int(root.get_attribute("data-frame"))
    box.press("Enter")
    until("d.heard !== undefined")
    assert int(root.get_attribute("data-heard")) - at <= 40  # two seconds, on a busy machine; about one on a free one
    until("d.prompt === 'a person jumps twice'")
    until("Number(d.frame) > Number(d.heard) + 12")
    notebook.shoot(root, shots / "09-stream.png")
    box.fill("")
    box.press("Enter")
    root.get_by_text("The prompt is empty").wait_for()
    changes(canvas, lambda: None)  # it goes on
    root.locator(".livestream-start").click()
    until("d.playing === 'no'")
    notebook.check()
