"""A web page that plays motions: one file, no network, opened by a double click.

The drawing lives in player.js. Here the joints are packed small (two bytes a number; a minute of motion is
some 210 kB of text) and everything is put into one page, where a caption can never become markup.
"""

from __future__ import annotations

import base64
import html
import json
from importlib import resources

import numpy as np

from minicmdm.data.skeleton import FPS, SKELETONS, skeleton_of
from minicmdm.evaluation.metrics import CONTACT_HEIGHT, SKATING_SPEED

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>body {{ margin: 0 auto; max-width: {width}px; padding: 12px; background: #fff; }}</style>
</head>
<body>
<div id="player"></div>
<noscript><p>This player needs JavaScript. It would show:</p>{list}</noscript>
<script id="motions" type="application/json">{data}</script>
<script>
{script}
const motions = JSON.parse(document.getElementById("motions").textContent);
const player = minicmdmPlayer(document.getElementById("player"), motions);
if (!matchMedia("(prefers-reduced-motion: reduce)").matches) player.play();
</script>
</body>
</html>
"""


def player_script() -> str:
    """The source of player.js, which defines minicmdmPlayer(root, data)."""
    return resources.files("minicmdm.viz").joinpath("player.js").read_text(encoding="utf-8")


def foot_contacts(joints: np.ndarray, fps: float = FPS) -> np.ndarray:
    """What the left and the right foot do in each frame (T, 2): 0 in the air, 1 planted, 2 sliding over the floor.

    Joints (T, 22 or 21, 3) in metres; the floor is y = 0. Heights and speeds are those of `metrics.skating_ratio`.
    """
    joints = np.asarray(joints, dtype=np.float64)
    feet = joints[:, skeleton_of(joints.shape[1]).feet]  # (T,2,3)
    low = feet[..., 1] < CONTACT_HEIGHT
    speed = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=-1) * fps  # (T-1,2)
    step = low[:-1] & low[1:] & (speed > SKATING_SPEED)
    slides = np.pad(step, ((1, 0), (0, 0))) | np.pad(step, ((0, 1), (0, 0)))  # in the step to or from this frame
    return low.astype(int) + slides


def player_data(
    joints_list: list[np.ndarray],
    captions: list[str],
    fps: float = FPS,
    noise: list[np.ndarray | None] | None = None,
) -> dict:
    """What minicmdmPlayer draws, ready for JSON: motions (T, 22, 3), or all (T, 21, 3), in metres as int16 in base64.

    `noise` holds for each motion how noisy its frames are, (T,) from 0 (clean) to 1, or None. ValueError when a motion
    is neither or not finite, a noise is not (T,) and within 0..1, or their numbers and the captions' differ.
    """
    joints_list = [np.asarray(joints, dtype=np.float64) for joints in joints_list]
    if not joints_list or len(joints_list) != len(captions):
        raise ValueError(f"expected one caption per motion, got {len(joints_list)} motions, {len(captions)} captions")
    noise = [None] * len(joints_list) if noise is None else list(noise)
    if len(noise) != len(joints_list):
        raise ValueError(f"expected one noise per motion or None, got {len(joints_list)} motions, {len(noise)} noises")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number of frames per second, got {fps}")
    clips, shapes = [], [(body.num_joints, 3) for body in SKELETONS]
    for index, (joints, caption, levels) in enumerate(zip(joints_list, captions, noise)):
        if joints.ndim != 3 or joints.shape[1:] not in shapes or len(joints) == 0:
            told = " or ".join(f"(T, {count}, {three})" for count, three in shapes)
            raise ValueError(f"motion {index} must have shape {told}, got {joints.shape}")
        shapes = [joints.shape[1:]]  # of all that follow: one page shows one kind of body
        if not np.isfinite(joints).all():
            raise ValueError(f"motion {index} holds NaN or infinite numbers")
        scale = max(float(np.abs(joints).max()), 1e-6) / 32767  # 0.1 mm within 3 m of the origin
        clips.append(
            {
                "caption": str(caption),
                "frames": len(joints),
                "scale": scale,
                "joints": _base64(np.round(joints / scale).astype("<i2")),
                "contacts": "".join(map(str, foot_contacts(joints, fps).ravel())),
                "noise": None if levels is None else _base64(np.uint8(np.round(255 * checked_noise(levels, joints)))),
            }
        )
    body = skeleton_of(shapes[0][0])
    shown = {"parents": list(body.parents), "sides": body.sides, "feet": list(body.feet), "head": body.head}
    return {"fps": float(fps), **shown, "clips": clips}


def checked_noise(levels: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """The noise of each frame as (T,) floats. ValueError: not one number from 0 to 1 for each frame of the motion."""
    levels = np.asarray(levels, dtype=np.float64)
    if levels.shape != joints.shape[:1] or not ((levels >= 0) & (levels <= 1)).all():
        raise ValueError(f"noise must be {len(joints)} numbers from 0 (clean) to 1, one a frame, got {levels!r:.80}")
    return levels


def _base64(numbers: np.ndarray) -> str:
    return base64.b64encode(numbers.tobytes()).decode("ascii")


def html_page(
    joints_list: list[np.ndarray],
    captions: list[str],
    fps: float = FPS,
    noise: list[np.ndarray | None] | None = None,
) -> str:
    """A self-contained page that plays motions (T, 22, 3) side by side in step, each under its caption.

    `noise` as in `player_data`.
    """
    captions = [str(caption) for caption in captions]
    data = json.dumps(player_data(joints_list, captions, fps, noise))
    for letter in "<>&":  # inside a script element only these could end it; JSON may write them as escapes
        data = data.replace(letter, f"\\u{ord(letter):04x}")
    return _PAGE.format(
        title=html.escape(" | ".join(captions)[:120]) or "motion",
        width=760 if len(captions) == 1 else 1500,
        list="".join(f"<p>{html.escape(caption)}</p>" for caption in captions),
        data=data,
        script=player_script(),
    )
