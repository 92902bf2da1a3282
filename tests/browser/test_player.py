"""The player's own script, in a page that stands alone: scrub, play, orbit, the boxes, the keys."""

import numpy as np
import pytest

from minicmdm.viz.player import html_page

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]


def walker(frames: int, speed: float = 1.0) -> np.ndarray:
    """A stiff figure (T, 22, 3) that swings its legs and slides along +Z, both feet on the floor."""
    from minicmdm.data import skeleton as sk

    t = np.arange(frames) / sk.FPS
    rotations = np.tile([1.0, 0, 0, 0], (frames, 22, 1))
    rotations[:, 16] = sk.quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), 4 * t)
    joints = sk.forward_kinematics(rotations, np.stack([0 * t, 0 * t, speed * t], axis=-1))
    joints[..., 1] -= joints[:, 10:12, 1].min() - 0.02
    return joints


@pytest.fixture
def player(page, tmp_path):
    """The page, opened as a double click opens it, and paused."""
    path = tmp_path / "player.html"
    noise = np.repeat(np.linspace(0, 1, 10), 4)
    motions = [walker(40), walker(40, speed=0.0), walker(20)]
    path.write_text(html_page(motions, ["slides", "stands", "short"], noise=[None, noise, None]), encoding="utf-8")
    page.goto(path.as_uri())
    return page


def pictures(page) -> list[str]:
    """What the canvases of the skeletons show."""
    return page.locator("figure canvas").evaluate_all("(all) => all.map((canvas) => canvas.toDataURL())")


def frame(page) -> int:
    return int(page.locator("#player").get_attribute("data-frame"))


def test_scrubbing_shows_another_frame_of_every_motion_in_step(player, shots):
    slider, before = player.get_by_label("Frame"), pictures(player)
    assert len(set(before)) > 1 and frame(player) == 0
    slider.fill("12")
    after = pictures(player)
    assert frame(player) == 12 and all(a != b for a, b in zip(before, after))
    assert "frame 12 of 39, 0.60 s" in player.locator("output").inner_text()
    slider.fill("30")
    later = pictures(player)
    slider.fill("39")
    last = pictures(player)
    assert later[0] != last[0] and later[2] == last[2]  # the short one waits at its end
    player.screenshot(path=shots / "player.png")


def test_it_plays_at_the_speed_asked_for_and_pauses(player):
    player.get_by_label("Speed").select_option("2")
    player.get_by_role("button", name="play").click()
    player.wait_for_function("player && Number(document.getElementById('player').dataset.frame) > 3")
    player.get_by_role("button", name="pause").click()
    still, shown = frame(player), pictures(player)
    player.wait_for_timeout(150)
    assert frame(player) == still and pictures(player) == shown


def test_dragging_orbits_the_wheel_zooms_and_home_brings_back(player):
    player.get_by_label("Frame").fill("8")
    seen = [pictures(player)]
    player.locator("figure canvas").first.hover()
    player.mouse.down()
    player.mouse.move(300, 300, steps=4)
    player.mouse.up()
    seen.append(pictures(player))
    player.mouse.wheel(0, 400)
    player.wait_for_function("(old) => document.querySelector('figure canvas').toDataURL() !== old", arg=seen[1][0])
    seen.append(pictures(player))
    for number in range(3):  # one camera for all
        assert len({shown[number] for shown in seen}) == 3
    player.get_by_role("button", name="reset view").click()
    assert pictures(player) == seen[0]


def test_trail_and_contacts_can_be_switched_off_and_on(player):
    player.get_by_label("Frame").fill("8")
    both = pictures(player)
    player.get_by_label("contacts").uncheck()
    bare = pictures(player)
    assert all(a != b for a, b in zip(both, bare))
    player.get_by_label("trail").uncheck()
    assert pictures(player)[0] != bare[0]
    player.keyboard.press("c")
    player.keyboard.press("t")
    assert pictures(player) == both


@pytest.mark.parametrize(("name", "rgb"), [("planted", [20, 120, 70]), ("sliding", [205, 20, 40])])
def test_a_planted_foot_and_a_sliding_one_look_different(player, name, rgb):
    player.get_by_label("Frame").fill("8")
    player.get_by_label("trail").uncheck()  # its colour is close to the ring's
    counts = player.locator("figure canvas").evaluate_all(
        """(all, rgb) => all.map((canvas) => {
            const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            let count = 0;
            for (let i = 0; i < pixels.length; i += 4) {
                count += rgb.every((value, c) => Math.abs(pixels[i + c] - value) < 12);
            }
            return count;
        })""",
        rgb,
    )
    assert [count > 30 for count in counts] == ([False, True, False] if name == "planted" else [True, False, True])


def test_noise_is_a_strip_below_the_scrub_bar_and_a_colour_of_the_limbs(player):
    strip = player.get_by_label("Noise: stands")
    ends = strip.evaluate("(c) => [0, 39].map((x) => [...c.getContext('2d').getImageData(x, 0, 1, 1).data])")
    assert ends == [[214, 218, 226, 255], [176, 112, 126, 255]] and player.locator("[aria-label^=Noise]").count() == 1
    box, slider = strip.bounding_box(), player.get_by_label("Frame").bounding_box()
    assert slider["x"] <= box["x"] and box["width"] <= slider["width"] and box["y"] >= slider["y"]
    reds = player.locator("figure canvas").evaluate_all(
        """(all) => all.map((canvas) => { // the head, which noise turns from grey to greyish red
            const context = canvas.getContext("2d");
            player.seek(39);
            const p = context.getImageData(0, 0, canvas.width, canvas.height).data;
            let count = 0;
            for (let i = 0; i < p.length; i += 4) {
                count += Math.abs(p[i] - 160) < 4 && Math.abs(p[i + 1] - 106) < 4 && Math.abs(p[i + 2] - 120) < 4;
            }
            return count;
        })"""
    )
    assert [count > 50 for count in reds] == [False, True, False]


def test_keys_step_and_play(player):
    player.locator("#player").focus()
    for key, expected in [("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", 39), ("Home", 0)]:
        player.keyboard.press(key)
        assert frame(player) == expected
    player.keyboard.press(" ")
    player.wait_for_function("Number(document.getElementById('player').dataset.frame) > 2")
    player.keyboard.press(" ")
    assert player.get_by_role("button", name="play").is_visible()
