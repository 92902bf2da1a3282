"""A mini KIT-ML in its exact layout, made of toy motions: 21 joints, 251 features in its units, 12.5 fps."""

import numpy as np

from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints, joints_to_features
from minicmdm.data.skeleton import FPS, KIT21

# Which of our 22 joints stands for each of KIT-ML's 21; its heels are made of an ankle and a foot.
OURS = (0, 3, 9, 12, 15, 17, 19, 21, 16, 18, 20, 2, 5, 8, 8, 11, 1, 4, 7, 7, 10)
HEELS = {14: (8, 11), 19: (7, 10)}


def to_kit(joints):
    """Joints (T,22,3) at 20 fps as KIT-ML's (T',21,3) at 12.5 fps, in metres."""
    kit = joints[:, OURS].astype(np.float64)
    for heel, (ankle, foot) in HEELS.items():
        kit[:, heel] = 0.7 * joints[:, ankle] + 0.3 * joints[:, foot]
        kit[:, heel, 1] = joints[:, foot, 1]
    times = np.arange(0, (len(kit) - 1) / FPS, 1 / KIT21.fps) * FPS
    before = times.astype(int)
    part = (times - before)[:, None, None]
    return kit[before] * (1 - part) + kit[before + 1] * part


def kit_joints(number=0):
    """A toy motion as (T,21,3)."""
    return to_kit(features_to_joints(make_clip("train", number).features.astype(np.float64)))


def write_kit(root, counts=None, tags="0.0#0.0"):
    """Write the folder: NAME.npy, texts, splits, Mean and Std."""
    for name in ("new_joint_vecs", "texts"):
        (root / name).mkdir(parents=True)
    number, everything = 0, []
    for split, count in (counts or {"train": 6, "val": 2, "test": 6}).items():
        names = []
        for _ in range(count):
            clip, name = make_clip("train", number), f"{number + 1:05d}"
            features = joints_to_features(kit_joints(number)).astype(np.float32)  # (T,251)
            np.save(root / "new_joint_vecs" / f"{name}.npy", features)
            rows = [f"{text}#{' '.join(f'{word}/X' for word in text.split())}#{tags}\n" for text in clip.captions]
            (root / "texts" / f"{name}.txt").write_text("".join(rows), encoding="utf-8")
            names, number = [*names, name], number + 1
            everything.append(features)
        (root / f"{split}.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    frames = np.concatenate(everything)
    np.save(root / "Mean.npy", frames.mean(0))
    np.save(root / "Std.npy", frames.std(0) + 1e-3)
    return root
