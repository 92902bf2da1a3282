"""The notebooks' widgets in JupyterLab, as a student meets them: every cell is run, hands are laid on the widgets.

The harness is tested first, on a notebook made here: it moves what can be moved, and it hears what goes wrong.
"""

import re

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]

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


def changes(place, act, patience: float = 20) -> str:
    """Do `act` and wait until the picture in `place` (an image's address, a canvas's pixels) is another one."""
    read = "(e) => e.tagName === 'CANVAS' ? e.toDataURL() : e.src"
    before = place.evaluate(read)
    act()
    place.page.wait_for_function(
        f"([e, before]) => ({read})(e) !== before", arg=[place.element_handle(), before], timeout=1000 * patience
    )
    return place.evaluate(read)


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
