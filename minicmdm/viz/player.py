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

from minicmdm.data.skeleton import FPS, LEFT_JOINTS, NUM_JOINTS, PARENTS, RIGHT_JOINTS

SIDES = ["left" if j in LEFT_JOINTS else "right" if j in RIGHT_JOINTS else "middle" for j in range(NUM_JOINTS)]

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


def player_data(joints_list: list[np.ndarray], captions: list[str], fps: float = FPS) -> dict:
    """What minicmdmPlayer draws, ready for JSON: motions (T, 22, 3) in metres as scaled int16 in base64.

    ValueError when a motion is not (T, 22, 3) and finite, or when captions and motions differ in number.
    """
    joints_list = [np.asarray(joints, dtype=np.float64) for joints in joints_list]
    if not joints_list or len(joints_list) != len(captions):
        raise ValueError(f"expected one caption per motion, got {len(joints_list)} motions, {len(captions)} captions")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number of frames per second, got {fps}")
    clips = []
    for index, (joints, caption) in enumerate(zip(joints_list, captions)):
        if joints.ndim != 3 or joints.shape[1:] != (NUM_JOINTS, 3) or len(joints) == 0:
            raise ValueError(f"motion {index} must have shape (T, {NUM_JOINTS}, 3), got {joints.shape}")
        if not np.isfinite(joints).all():
            raise ValueError(f"motion {index} holds NaN or infinite numbers")
        scale = max(float(np.abs(joints).max()), 1e-6) / 32767  # 0.1 mm within 3 m of the origin
        packed = np.round(joints / scale).astype("<i2").tobytes()
        encoded = base64.b64encode(packed).decode("ascii")
        clips.append({"caption": str(caption), "frames": len(joints), "scale": scale, "joints": encoded})
    return {"fps": float(fps), "parents": list(PARENTS), "sides": SIDES, "clips": clips}


def html_page(joints_list: list[np.ndarray], captions: list[str], fps: float = FPS) -> str:
    """A self-contained page that plays motions (T, 22, 3) side by side in step, each under its caption."""
    captions = [str(caption) for caption in captions]
    data = json.dumps(player_data(joints_list, captions, fps))
    for letter in "<>&":  # inside a script element only these could end it; JSON may write them as escapes
        data = data.replace(letter, f"\\u{ord(letter):04x}")
    return _PAGE.format(
        title=html.escape(" | ".join(captions)[:120]) or "motion",
        width=760 if len(captions) == 1 else 1500,
        list="".join(f"<p>{html.escape(caption)}</p>" for caption in captions),
        data=data,
        script=player_script(),
    )
