"""KIT-ML: another body, another rate, other units, by the same functions; and its folder."""

import json

import numpy as np
import pytest
from kit_helpers import kit_joints, write_kit
from PIL import Image

from minicmdm import cli
from minicmdm.data import features as ft
from minicmdm.data import skeleton as sk
from minicmdm.data.dataset import make_clip
from minicmdm.data.folders import load_dataset
from minicmdm.data.inspection import inspect_folder
from minicmdm.models.tmr import PARTS, parts_of
from minicmdm.motion import Motion, load_joints
from minicmdm.viz import player, plots

KIT = sk.KIT21
POSITIONS, ROTATIONS, VELOCITIES, CONTACTS = slice(4, 64), slice(64, 184), slice(184, 247), slice(247, 251)


@pytest.fixture(scope="module")
def joints():
    return ft.canonicalize(kit_joints())


def test_the_numbers_of_both_bodies():
    assert [sk.skeleton_of(size) for size in (22, 263, 67)] == [sk.SMPL22] * 3
    assert [sk.skeleton_of(size) for size in (21, 251, 64)] == [KIT] * 3
    assert KIT.blocks == (POSITIONS, ROTATIONS, VELOCITIES, CONTACTS)
    assert sk.SMPL22.blocks == (slice(4, 67), slice(67, 193), slice(193, 259), slice(259, 263))
    with pytest.raises(ValueError, match="251 features or 21 joints .*252 came"):
        sk.skeleton_of(252)
    for body in sk.SKELETONS:
        assert all(parent < joint for joint, parent in enumerate(body.parents))
        links = {(a, b) for chain in body.chains for a, b in zip(chain, chain[1:])}
        assert links == {(parent, joint) for joint, parent in enumerate(body.parents) if joint}


def test_there_and_back(joints):
    features = ft.joints_to_features(joints)
    assert features.shape == (len(joints) - 1, 251)
    np.testing.assert_allclose(ft.features_to_joints(features), joints[:-1], atol=1e-9)
    last = ft.turn(features[-1, VELOCITIES].reshape(21, 3), -2 * features[:-1, 0].sum()) * KIT.unit  # the step lost
    again = ft.features_to_joints(features)
    again = ft.joints_to_features(np.concatenate([again, again[-1:] + last]))
    np.testing.assert_allclose(again, features, atol=1e-6)
    single = ft.features_to_joints(features.astype(np.float32))
    assert single.dtype == np.float32 and np.abs(single - joints[:-1]).max() < 5e-5
    assert np.array_equal(ft.features_to_joints(ft.essential(features)), ft.features_to_joints(features))
    assert ft.coordinates(features).shape == (len(features), 63)
    turned = ft.turn(joints, np.full(len(joints), 1.1)) + [3.0, 0.0, -2.0]
    np.testing.assert_allclose(ft.joints_to_features(turned), features, atol=1e-6)


def test_every_column_is_what_the_format_says(joints):
    """In KIT-ML's units, frame by frame, from the definition."""
    features, t = ft.joints_to_features(joints), len(joints) // 2
    units = joints * 480 / 0.75
    yaw = ft.smooth_yaw(ft.facing_yaw(joints))
    assert 400 < features[:, 3].mean() < 700  # the root's height, 560 in the release
    np.testing.assert_allclose(features[t, 3], units[t, 0, 1])
    np.testing.assert_allclose(features[t, 0], (yaw[t] - yaw[t + 1]) / 2)
    step = units[t + 1] - units[t]
    np.testing.assert_allclose(features[t, 1:3], ft.turn(step[0], -yaw[t + 1])[[0, 2]], atol=1e-9)
    local = ft.turn(units[t], -yaw[t])
    np.testing.assert_allclose(features[t, POSITIONS].reshape(20, 3), local[1:] - local[0] * [1, 0, 1], atol=1e-9)
    np.testing.assert_allclose(features[t, VELOCITIES].reshape(21, 3), ft.turn(step, -yaw[t]), atol=1e-9)
    still = (np.diff(units, axis=0)[:, [19, 20, 14, 15]] ** 2).sum(-1) < 0.05  # left heel and foot, then right
    assert np.array_equal(features[:, CONTACTS], still)


def test_6d_block_rebuilds_every_bone(joints):
    features, lengths = ft.joints_to_features(joints), np.linalg.norm(joints - joints[:, KIT.parents], axis=-1)
    local = sk.sixd_to_matrix(features[:, ROTATIONS].reshape(-1, 20, 6))
    seen = ft.turn(joints, -ft.smooth_yaw(ft.facing_yaw(joints)))[:-1]
    for chain in KIT.chains:
        world = np.eye(3)
        for parent, joint in zip(chain, chain[1:]):
            world = world @ local[:, joint - 1]
            bone = world @ KIT.raw_directions[joint] * lengths[:-1, joint, None]
            np.testing.assert_allclose(bone, seen[:, joint] - seen[:, parent], atol=1e-9)


def test_left_is_left(joints):
    """A body that faces +Z has all that is left at +X, in every table; and its mirror image turns the other way."""
    rest = joints[0]
    assert abs(ft.facing_yaw(joints[:1])[0]) < 1e-9
    for left, right in KIT.left_right:
        assert KIT.joint_names[left] == KIT.joint_names[right].replace("right", "left") != KIT.joint_names[right]
        assert (KIT.sides[left], KIT.sides[right]) == ("left", "right")
    assert all(rest[left, 0] > rest[right, 0] for left, right in ((16, 11), (8, 5), (9, 6)))
    assert rest[KIT.feet[0], 0] > rest[KIT.feet[1], 0] and rest[KIT.head, 1] == rest[:, 1].max()
    assert rest[20, 2] > rest[19, 2] > rest[18, 2] - 1e-9  # toes in front
    mirrored = ft.mirror_joints(joints)
    np.testing.assert_array_equal(mirrored[:, 10], joints[:, 7] * [-1, 1, 1])
    a, b = ft.joints_to_features(joints), ft.joints_to_features(mirrored)
    np.testing.assert_allclose(b[:, :4], a[:, :4] * [-1, -1, 1, 1], atol=1e-9)
    np.testing.assert_array_equal(b[:, CONTACTS], a[:, [249, 250, 247, 248]])


def test_the_released_recipe_swaps_its_hips(joints):
    """From the definition: smoothed vectors, hips swapped, first heading 0; recovery undoes any heading."""
    from scipy.ndimage import gaussian_filter1d

    across = sk.normalize((joints[:, 16] - joints[:, 11]) + (joints[:, 5] - joints[:, 8]))
    ahead = sk.normalize(gaussian_filter1d(sk.cross([0.0, 1.0, 0.0] + 0 * across, across), 20, axis=0, mode="nearest"))
    yaw = np.arctan2(ahead[:, 0], ahead[:, 2])
    yaw[0] = 0
    features = ft.joints_to_features(joints, heading="humanml3d")
    np.testing.assert_allclose(features[:, 0], -np.diff(yaw) / 2, atol=1e-9)
    np.testing.assert_allclose(ft.features_to_joints(features), joints[:-1], atol=1e-9)


def test_the_teachers_parts_share_out_every_column():
    parts = parts_of(KIT)
    shared = sorted(column for columns in parts.values() for column in columns)
    assert list(parts) == list(PARTS) and set(shared) == set(range(251))
    twice = {column for column in shared if shared.count(column) > 1}
    assert twice == {*range(10, 13), *range(76, 82), *range(193, 196)}  # joint 3 carries both arms
    assert {249, 250} <= set(parts["right_leg"]) and {247, 248} <= set(parts["left_leg"])


# --- the folder ---------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    return write_kit(tmp_path / "kit", {"train": 2, "val": 1})


def test_the_folder_is_read_by_its_own_rules(folder, capsys):
    clips = load_dataset(folder).clips
    assert [clip.features.shape[1] for clip in clips] == [251, 251]
    truth = make_clip("train", 0)
    assert clips[0].captions == truth.captions
    assert abs(len(clips[0].features) / 12.5 - len(truth.features) / 20) < 0.25  # it lasts as long
    vecs, texts = folder / "new_joint_vecs", folder / "texts"
    for name, frames in (("00001", 24), ("00002", 230)):
        np.save(vecs / f"{name}.npy", np.random.default_rng(0).normal(size=(frames, 251)).astype(np.float32))
    assert [len(clip.features) for clip in load_dataset(folder).clips] == [24, 196]
    np.save(vecs / "00001.npy", np.zeros((23, 251), np.float32))
    (texts / "00002.txt").write_text("he walks#x#0.0#0.0\nhe waves#x#2.0#5.0\n")
    whole, part = load_dataset(folder).clips
    np.testing.assert_array_equal(part.features, whole.features[25:62])  # 12.5 frames a second, not 20
    assert cli.main(["data", "info", str(folder), "--json"]) == 0
    card = json.loads(capsys.readouterr().out)
    assert (card["features"], card["joints"], card["fps"], card["frames_least"]) == (251, 21, 12.5, 23)
    frames = 23 + 230 + len(load_dataset(folder, "val").clips[0].features)
    assert card["seconds"] == pytest.approx(frames / 12.5, abs=0.1)
    assert [line for line in card["wrong"] if "under 24 are left out" in line]


def test_one_body_a_folder(folder):
    np.save(folder / "new_joint_vecs" / "00002.npy", np.zeros((60, 263), np.float32))
    said = "00002.npy holds 263 features a frame, and what was read before it 251"
    with pytest.raises(ValueError, match=said):
        load_dataset(folder)
    card, wrong = inspect_folder(folder)
    assert card["features"] == 251 and [line for line in wrong if said in line]
    np.save(folder / "new_joint_vecs" / "00002.npy", np.zeros((60, 251), np.float32))
    np.save(folder / "Std.npy", np.ones(263))
    with pytest.raises(ValueError, match=r"Std.npy: expected 251 finite numbers, got .*\(263,\)"):
        load_dataset(folder)


def test_it_is_shown_with_its_own_bones(joints, tmp_path):
    motion = Motion(joints.astype(np.float32), caption="kit", fps=KIT.fps)
    data = player.player_data([joints], ["kit"], motion.fps)
    assert data["fps"] == 12.5 and data["head"] == 4 and data["feet"] == [20, 15]
    assert data["parents"] == list(KIT.parents) and data["sides"][16] == "left" and data["sides"][0] == "middle"
    with pytest.raises(ValueError, match=r"motion 1 must have shape \(T, 21, 3\)"):
        player.player_data([joints, np.zeros((4, 22, 3))], ["a", "b"])
    with Image.open(motion.save(tmp_path / "a.gif")) as picture:
        assert picture.n_frames == len(joints) and picture.info["duration"] == 80  # ms: real time
    assert '"head": 4' in motion.save(tmp_path / "a.html").read_text(encoding="utf-8")
    assert np.array_equal(load_joints(motion.save(tmp_path / "a.npy")), motion.joints)
    with pytest.raises(ValueError, match=r"22, 3\)"):
        motion.save(tmp_path / "a.bvh")
    assert not (tmp_path / "a.bvh").exists()
    assert plots.pose_strip(joints, poses=3).size == (390, 200)
