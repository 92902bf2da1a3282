"""The player's page, the strips of poses and the GIFs; the drawing itself was looked at by eye."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from minicmdm.data import skeleton as sk
from minicmdm.viz import player, plots

NASTY = 'waves </script><script>alert(1)</script> <!-- & "left" {braces}'


def motion(frames=12, seed=0):
    """A standing body that walks along +Z and swings its left arm: (T, 22, 3)."""
    t = np.arange(frames) / sk.FPS
    rotations = np.tile([1.0, 0, 0, 0], (frames, 22, 1))
    swing = np.random.default_rng(seed).uniform(0.5, 1.5)
    rotations[:, 16] = sk.quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), swing * t * 4)
    root = np.stack([0 * t, 0.93 + 0 * t, 1.2 * t], axis=-1)
    return sk.forward_kinematics(rotations, root)


class Elements(HTMLParser):
    """Counts start tags and keeps the text of each script, as a browser would see them."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.scripts, self.sources = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]

    def handle_data(self, text):
        if self.tags[-1:] == ["script"] and text.strip():
            self.scripts.append(text)


def test_page_stands_alone_and_holds_the_motion_within_a_tenth_of_a_millimetre():
    first, second = motion(12), motion(30, seed=1)
    page = player.html_page([first, second], ["one", "two"])
    elements = Elements(page)
    assert elements.sources == [] and not re.search(r"https?://|import |fetch\(|XMLHttp|WebSocket", page)
    data = json.loads(elements.scripts[0])
    assert data["fps"] == 20 and data["parents"] == list(sk.PARENTS)
    assert [data["sides"][j] for j in (4, 5, 9)] == ["left", "right", "middle"]
    for clip, joints, caption in zip(data["clips"], [first, second], ["one", "two"]):
        numbers = np.frombuffer(base64.b64decode(clip["joints"]), dtype="<i2").reshape(-1, 22, 3)
        assert clip["caption"] == caption and clip["frames"] == len(joints) == len(numbers)
        np.testing.assert_allclose(numbers * clip["scale"], joints, atol=1e-4)


def test_caption_never_becomes_markup():
    plain, nasty = (Elements(player.html_page([motion()], [caption])) for caption in ("waves", NASTY))
    assert nasty.tags == plain.tags and len(nasty.scripts) == 2
    assert json.loads(nasty.scripts[0])["clips"][0]["caption"] == NASTY


def test_script_takes_an_element_and_data_and_nothing_else():
    script = player.player_script()
    assert "function minicmdmPlayer(root, data)" in script and "</script" not in script
    assert "getElementById" not in script and "innerHTML" not in script  # a widget has its own root
    assert "textContent = clip.caption" in script


@pytest.mark.parametrize(
    ("joints_list", "captions", "message"),
    [
        ([], [], "one caption per motion"),
        ([motion()], ["a", "b"], "1 motions, 2 captions"),
        ([motion()[:, :20]], ["a"], r"motion 0.*\(12, 20, 3\)"),
        ([motion(), motion()[:0]], ["a", "b"], r"motion 1.*\(0, 22, 3\)"),
        ([motion() * np.nan], ["a"], "NaN"),
    ],
)
def test_page_errors_teach(joints_list, captions, message):
    with pytest.raises(ValueError, match=message):
        player.html_page(joints_list, captions)


def test_a_foot_is_in_the_air_or_planted_or_slides():
    joints = np.repeat(motion(1), 8, axis=0)
    joints[:, 10:12, 1] = 0.02  # both stand ...
    joints[3:5, 11, 1] = 0.3  # ... but the right one is lifted in between
    assert player.foot_contacts(joints).tolist() == [[1, 1]] * 3 + [[1, 0]] * 2 + [[1, 1]] * 3
    joints[:, :, 0] += 0.03 * np.arange(8)[:, None]  # 0.6 m/s at 20 fps
    assert player.foot_contacts(joints)[:, 0].tolist() == [2] * 8
    assert player.foot_contacts(joints, fps=10).max() == 1
    joints[3:, :, 0] = joints[3, 0, 0]  # the last step that slides ends in frame 3
    assert player.foot_contacts(joints)[:, 0].tolist() == [2, 2, 2, 2, 1, 1, 1, 1]
    assert player.foot_contacts(joints[:1]).tolist() == [[1, 1]]
    clip = player.player_data([joints], ["a"])["clips"][0]
    assert clip["contacts"][:8] == "22222220" and len(clip["contacts"]) == 2 * 8 and clip["noise"] is None


def test_noise_is_packed_a_byte_a_frame_and_refused_where_it_does_not_fit():
    joints, levels = motion(5), np.array([0, 0.2, 0.5, 1, 0])
    clips = player.player_data([joints, joints], ["a", "b"], noise=[None, levels])["clips"]
    assert clips[0]["noise"] is None and [*base64.b64decode(clips[1]["noise"])] == [0, 51, 128, 255, 0]
    assert clips[1]["noise"] in player.html_page([joints, joints], ["a", "b"], noise=[None, levels])
    for bad in (levels[:4], levels * 1.1, levels - 0.1, levels * np.nan, 0.5, levels[:, None]):
        with pytest.raises(ValueError, match="noise must be 5 numbers from 0"):
            player.player_data([joints], ["a"], noise=[bad])
        with pytest.raises(ValueError, match="noise must be 5 numbers from 0"):
            plots.pose_strip(joints, noise=bad)
    with pytest.raises(ValueError, match="2 motions, 1 noises"):
        player.player_data([joints, joints], ["a", "b"], noise=[levels])


def colours(image):
    """Which of the limbs' colours an image shows."""
    pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    return {
        name
        for name, colour in [("left", plots.LEFT), ("right", plots.RIGHT), ("head", plots.MIDDLE)]
        if (np.abs(pixels - colour).max(axis=1) <= 8).sum() > 20
    }


def test_strip_shows_both_sides_and_grows_with_poses_and_caption(tmp_path):
    strip = plots.pose_strip(motion(), tmp_path / "strip.png", poses=5)
    assert colours(strip) == {"left", "right", "head"}
    assert np.array_equal(np.asarray(Image.open(tmp_path / "strip.png")), np.asarray(strip))
    assert plots.pose_strip(motion(), poses=10).width == 2 * strip.width
    assert plots.pose_strip(motion(), poses=2, caption="word " * 30).height > strip.height + 30
    assert plots.pose_strip(motion(1), poses=3).width > 0


def test_strip_turns_noisy_frames_greyish_red_and_shows_the_noise_below():
    joints, levels = motion(9), np.linspace(0, 1, 9)
    plain, noisy = plots.pose_strip(joints, poses=3), plots.pose_strip(joints, poses=3, noise=levels)
    assert noisy.height == plain.height + 14
    first, last = (noisy.crop((left, 0, left + 130, 200)) for left in (0, 260))
    assert np.array_equal(np.asarray(first), np.asarray(plain.crop((0, 0, 130, 200))))
    assert colours(first) == {"left", "right", "head"} and colours(last) == set()
    bar = np.asarray(noisy)[204, 65:325].astype(int)
    assert tuple(bar[0]) == plots.CLEAN and tuple(bar[-1]) == plots.NOISE and (np.diff(bar[:, 1]) <= 0).all()
    assert plots.pose_strip(joints, poses=1, noise=levels).height == noisy.height
    script = player.player_script()  # draws in the same colours
    for colour in (plots.NOISE, plots.CLEAN, plots.LEFT, plots.RIGHT, plots.MIDDLE):
        assert str(list(colour)) in script


def test_left_arm_is_drawn_where_the_left_arm_is():
    def centre(picture):  # mean column of what is orange
        pixels = np.asarray(picture).astype(int)
        return np.nonzero(np.abs(pixels - plots.LEFT).max(axis=-1) <= 8)[1].mean()

    # Seen from the front, a person's left is at the viewer's right.
    rest = motion(1)
    assert centre(plots.pose_strip(rest, poses=1)) > 65
    assert centre(plots.pose_strip(rest * [-1, 1, 1], poses=1)) < 65


def test_camera_follows_the_root_and_the_floor_does_not():
    still = np.repeat(motion(1), 2, axis=0)
    moved = still + [0.37, 0.0, 0.0]
    a, b = (np.asarray(plots.pose_strip(joints, poses=1)).astype(int) for joints in (still, moved))
    limbs = [np.abs(picture - plots.RIGHT).max(axis=-1) <= 8 for picture in (a, b)]
    assert np.array_equal(*limbs)  # the body stays in the picture's middle ...
    assert (a != b).any()  # ... while the grid below it has moved on
    lines = [plots._floor_lines(np.array([x, 0.9, 0.0])) for x in (0.0, 1.0)]
    assert np.allclose(np.mod(lines[0] + 0.25, 0.5), 0.25) and np.allclose(lines[1] - lines[0], [1.0, 0, 0])


def test_gif_plays_in_real_time_with_the_palette_we_chose(tmp_path):
    path = tmp_path / "motion.gif"
    plots.save_gif(motion(30), path, caption="walks & swings the left arm")
    with Image.open(path) as gif:
        durations = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            durations.append(gif.info["duration"])
            assert colours(gif) == {"left", "right", "head"}
        assert sum(durations) == 30 * 50 and gif.info["loop"] == 0
        assert gif.width == 320 and gif.height > 320


@pytest.mark.parametrize("joints", [np.zeros((4, 20, 3)), np.zeros((0, 22, 3)), np.full((4, 22, 3), np.nan)])
def test_pictures_refuse_what_is_no_motion(joints, tmp_path):
    for draw in (lambda: plots.pose_strip(joints), lambda: plots.save_gif(joints, tmp_path / "no.gif")):
        with pytest.raises(ValueError, match="joints"):
            draw()
    assert not list(tmp_path.iterdir())


def test_loss_curves_skip_what_was_not_measured(tmp_path):
    table = tmp_path / "losses.csv"
    table.write_text("step,loss,mpjpe\n20,0.5,\n40,0.4,\n40,,12.5\n")
    plots.save_loss_curves(table, tmp_path / "losses.png")
    with Image.open(tmp_path / "losses.png") as picture:
        assert picture.size == (800, 300)  # one axis for each of loss and mpjpe
    table.write_text("epoch,loss\n1,2\n")
    with pytest.raises(ValueError, match="step"):
        plots.save_loss_curves(table, tmp_path / "losses.png")
