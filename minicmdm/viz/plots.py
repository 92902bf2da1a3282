"""Pictures of motions and of training: a strip of poses, a GIF, curves of losses.

Skeletons are drawn with Pillow, far faster than Matplotlib at a few hundred short lines.
Everything is drawn twice as large and then halved, which smooths the edges.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from minicmdm.data.skeleton import FPS, SKELETONS, SMPL22, skeleton_of
from minicmdm.viz.player import checked_noise

PAPER, INK, SHADOW, TRAIL = (245, 246, 248), (31, 36, 48), (216, 219, 225), (205, 120, 150)
LEFT, RIGHT, MIDDLE = (224, 122, 31), (37, 99, 201), (69, 75, 87)
GRID, NOISE, CLEAN = (212, 216, 223), (176, 112, 126), (214, 218, 226)  # as player.js has them
OF_SIDE = {"left": LEFT, "right": RIGHT, "middle": MIDDLE}
COLOURS = [OF_SIDE[side] for side in SMPL22.sides]

YAW, PITCH, DISTANCE = 0.6, 0.22, 4.4  # where the camera stands: radians, radians, metres from the root
HEAD_JOINT, HEAD_RADIUS, BONE_WIDTH = SMPL22.head, 0.085, 0.04  # metres
SMOOTH = 2  # drawn this many times too large, then reduced


def pose_strip(
    joints: np.ndarray,
    path: str | Path | None = None,
    poses: int = 8,
    caption: str = "",
    noise: np.ndarray | None = None,
) -> Image.Image:
    """A row of `poses` frames of joints (T, 22, 3), evenly spaced in time; left is orange, right is blue.

    Where `noise` (T,), 0 clean to 1, is given, the limbs turn greyish red with it and a bar below shows every frame's.
    Returns the picture and, given a path, writes it there. ValueError for another shape or no poses.
    """
    joints = _checked(joints)
    if poses < 1:
        raise ValueError(f"poses must be at least 1, got {poses}")
    levels = np.zeros(len(joints)) if noise is None else checked_noise(noise, joints)
    width, height = 130, 200
    strip = Image.new("RGB", (width * poses, height + (0 if noise is None else 14)), PAPER)
    for column, frame in enumerate(np.linspace(0, len(joints) - 1, poses).round().astype(int)):
        picture = _draw_frame(joints, frame, width, height, levels[frame])
        pen = ImageDraw.Draw(picture)
        pen.text(
            (width / 2, height - 6),
            f"{frame / skeleton_of(joints.shape[1]).fps:.1f} s",
            fill=INK,
            font=_font(11),
            anchor="ms",
        )
        strip.paste(picture, (column * width, 0))
    if noise is not None:  # the bar goes from the middle of the first pose to the middle of the last
        bar = np.uint8(np.round(CLEAN + levels[:, None] * np.subtract(NOISE, CLEAN)))[None]  # (1,T,3)
        left = width // 2 if poses > 1 else 0
        bar = Image.fromarray(bar).resize((strip.width - 2 * left, 6), Image.Resampling.NEAREST)
        strip.paste(bar, (left, height + 2))
    strip = _with_caption(strip, caption)
    if path is not None:
        strip.save(path)
    return strip


def save_gif(joints: np.ndarray, path: str | Path, caption: str = "", fps: float = FPS, size: int = 320) -> None:
    """Write joints (T, 22, 3) as a looping GIF, `size` pixels wide, in real time (GIF counts in 10 ms).

    ValueError for another shape or a frame rate that is not positive.
    """
    joints = _checked(joints)
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number of frames per second, got {fps}")
    blank = _with_caption(Image.new("RGB", (size, size), PAPER), caption)  # the caption is drawn only once
    top = blank.height - size
    palette = _palette()
    frames = []
    for frame in range(len(joints)):
        blank.paste(_draw_frame(joints, frame, size, size), (0, top))
        frames.append(blank.quantize(palette=palette, dither=Image.Dither.NONE))
    duration = max(round(1000 / fps / 10) * 10, 20)  # milliseconds
    frames[0].save(path, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)


def save_loss_curves(csv_path: str | Path, png_path: str | Path) -> None:
    """Draw every column of a CSV of losses over its column `step`, one axis each; empty cells are gaps."""
    from matplotlib.figure import Figure  # imported here because it takes half a second

    with open(csv_path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows or "step" not in rows[0]:
        raise ValueError(f"{csv_path} must have a column 'step' and at least one row")
    columns = [column for column in rows[0] if column != "step"]
    figure = Figure(figsize=(4 * len(columns), 3), layout="constrained")
    for axis, column in zip(figure.subplots(1, len(columns), squeeze=False)[0], columns):
        points = [(int(row["step"]), float(row[column])) for row in rows if row[column]]
        axis.plot(*zip(*points), lw=1)
        axis.set(title=column, xlabel="step")
        if points and min(value for _, value in points) > 0:
            axis.set_yscale("log")
    figure.savefig(png_path, dpi=100)


def _draw_frame(joints: np.ndarray, frame: int, width: int, height: int, noise: float = 0.0) -> Image.Image:
    """One frame in perspective, camera on the root: floor, path so far, shadow, bones from far to near."""
    body = skeleton_of(joints.shape[1])
    clean = [*(OF_SIDE[side] for side in body.sides), MIDDLE]
    colours = [tuple(np.round(c + 0.85 * noise * np.subtract(NOISE, c)).astype(int)) for c in clean]
    width, height = width * SMOOTH, height * SMOOTH
    picture = Image.new("RGB", (width, height), PAPER)
    pen = ImageDraw.Draw(picture)
    pose, root = joints[frame], joints[frame, 0]

    def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2) of points (..., 3), and how many pixels a metre is at each (...)."""
        right, up, near = np.moveaxis((points - [root[0], 0.85, root[2]]) @ _CAMERA.T, -1, 0)
        scale = min(2.4 * width, 1.7 * height) / np.maximum(DISTANCE - near, 0.3)
        return np.stack([width / 2 + right * scale, height / 2 - up * scale], axis=-1), scale

    for a, b in project(_floor_lines(root))[0].reshape(-1, 2, 2):
        pen.line([*a, *b], fill=GRID, width=SMOOTH)
    on_floor = joints[: frame + 1, 0] * [1, 0, 1]
    if len(on_floor) > 1:
        pen.line(project(on_floor)[0].ravel().tolist(), fill=TRAIL, width=2 * SMOOTH)

    shadow, scale = project(pose * [1, 0, 1])
    for j, parent in enumerate(body.parents[1:], start=1):
        pen.line([*shadow[parent], *shadow[j]], fill=SHADOW, width=round(BONE_WIDTH * scale[j]))
    pixels, scale = project(pose)
    for j in sorted(range(1, body.num_joints), key=lambda j: scale[j] + scale[body.parents[j]]):  # far ones first
        _bone(pen, pixels[body.parents[j]], pixels[j], colours[j], BONE_WIDTH * scale[j])
    _disc(pen, pixels[body.head], HEAD_RADIUS * scale[body.head], colours[-1])
    return picture.reduce(SMOOTH)


def _bone(pen: ImageDraw.ImageDraw, a: np.ndarray, b: np.ndarray, colour: tuple, width: float) -> None:
    pen.line([*a, *b], fill=colour, width=max(round(width), 1))
    for end in (a, b):  # Pillow's lines have square ends
        _disc(pen, end, width / 2, colour)


def _disc(pen: ImageDraw.ImageDraw, centre: np.ndarray, radius: float, colour: tuple) -> None:
    pen.ellipse([*(centre - radius), *(centre + radius)], fill=colour)


def _floor_lines(root: np.ndarray, cell: float = 0.5, reach: int = 4) -> np.ndarray:
    """Ends (lines, 2, 3) of the floor's grid near the root; the grid itself stays where it is."""
    centre = np.round(root[[0, 2]] / cell) * cell
    across = np.arange(-reach, reach + 1) * cell
    lines = np.zeros((2, 2 * reach + 1, 2, 3))  # along x or z, which line, which end
    for direction, (along, side) in enumerate([(0, 2), (2, 0)]):
        lines[direction, :, :, along] = centre[along // 2] + across[[0, -1]]
        lines[direction, :, :, side] = centre[side // 2] + across[:, None]
    return lines.reshape(-1, 2, 3)


def _camera() -> np.ndarray:
    """Rows: right, up and towards the viewer, for a camera turned by YAW and raised by PITCH."""
    cos, sin = np.cos([YAW, PITCH]), np.sin([YAW, PITCH])
    turn = np.array([[cos[0], 0, -sin[0]], [0, 1, 0], [sin[0], 0, cos[0]]])
    return np.array([[1, 0, 0], [0, cos[1], -sin[1]], [0, sin[1], cos[1]]]) @ turn


_CAMERA = _camera()


def _palette() -> Image.Image:
    """A GIF palette with every colour we use and the mixtures that smooth edges are made of."""
    colours = [PAPER]
    for colour in (INK, SHADOW, TRAIL, LEFT, RIGHT, MIDDLE, GRID):
        for background in (PAPER, SHADOW, GRID):
            for share in (0.25, 0.5, 0.75, 1.0):
                colours.append(tuple(round(share * c + (1 - share) * p) for c, p in zip(colour, background)))
    image = Image.new("P", (1, 1))
    image.putpalette([channel for colour in dict.fromkeys(colours) for channel in colour])
    return image


def _font(size: int) -> ImageFont.ImageFont:
    """Pillow's own font: at any size since 10.1, at one size before."""
    try:
        return ImageFont.load_default(size=size)
    except TypeError:
        return ImageFont.load_default()


def _with_caption(picture: Image.Image, caption: str) -> Image.Image:
    """The picture under its caption, wrapped to its width; the picture itself when the caption is empty."""
    if not caption.strip():
        return picture
    font, lines = _font(13), [""]
    for word in caption.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > picture.width - 16:
            lines.append(word)
        else:
            lines[-1] = longer
    height = 18 * len(lines) + 6
    framed = Image.new("RGB", (picture.width, picture.height + height), PAPER)
    ImageDraw.Draw(framed).text((8, 5), "\n".join(lines), fill=INK, font=font, spacing=4)
    framed.paste(picture, (0, height))
    return framed


def _checked(joints: np.ndarray) -> np.ndarray:
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim != 3 or joints.shape[1:] not in [(body.num_joints, 3) for body in SKELETONS] or len(joints) == 0:
        raise ValueError(f"joints must have shape (T, 22, 3) or (T, 21, 3) in metres, got {joints.shape}")
    if not np.isfinite(joints).all():
        raise ValueError("joints hold NaN or infinite numbers, which cannot be drawn")
    return joints
