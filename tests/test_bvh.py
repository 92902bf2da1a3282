"""BVH: any channel order in, our joints out; and what we write, another program reads as we meant it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from minicmdm.data.bvh import Bvh, at_our_rate, find_map, joint_positions, read_bvh, to_joints
from minicmdm.data.bvh_out import write_bvh
from minicmdm.data.dataset import make_clip
from minicmdm.data.features import features_to_joints
from minicmdm.data.skeleton import BONE_LENGTHS, JOINT_NAMES, PARENTS

REFERENCE = Path(__file__).parents[2] / "shared" / "reference" / "bvh"
needs_reference = pytest.mark.skipif(not REFERENCE.is_dir(), reason="the ten reference BVH files are not here")
NAMED = {name: k for k, name in enumerate(JOINT_NAMES)}


def toy(index=3):
    return features_to_joints(make_clip("test", index).features).astype(np.float64)


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_rotations_in_any_order_are_scipys(order):
    rng = np.random.default_rng(0)
    angles, offset = rng.uniform(-180, 180, (5, 3)), rng.normal(size=3)
    channels = [[f"{axis}rotation" for axis in order], ["Zposition", "Yposition", "Xposition"], []]
    frames = np.concatenate([angles, rng.normal(size=(5, 3))], axis=1)
    bvh = Bvh(["a", "b", "c"], [-1, 0, 1], np.stack([np.zeros(3), np.ones(3), offset]), channels, frames, 0.05)
    found = joint_positions(bvh)
    turned = Rotation.from_euler(order, angles, degrees=True)  # capitals: about the body's own axes
    np.testing.assert_allclose(found[:, 1], turned.apply(frames[:, [5, 4, 3]]), atol=1e-12)  # positions, not the offset
    np.testing.assert_allclose(found[:, 2] - found[:, 1], turned.apply(offset), atol=1e-12)


def test_a_rigid_motion_comes_back_from_its_own_file(tmp_path):
    joints = toy()
    back = joint_positions(read_bvh(write_bvh(tmp_path / "a.bvh", joints)))
    bvh = read_bvh(tmp_path / "a.bvh")
    ours = back[:, [bvh.names.index(name) for name in JOINT_NAMES]]
    np.testing.assert_allclose(ours, joints, atol=2e-4)
    assert bvh.frame_time == pytest.approx(0.05) and len(bvh.frames) == len(joints)


def test_an_independent_reader_agrees(tmp_path):
    bvhio = pytest.importorskip("bvhio", reason="the independent BVH reader (bvhio) is not installed")
    joints = toy(5)
    write_bvh(tmp_path / "a.bvh", joints)
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    for frame in (0, len(joints) // 2, len(joints) - 1):
        root.loadPose(frame)
        for joint, _, _ in root.layout():
            place = [joint.PositionWorld.x, joint.PositionWorld.y, joint.PositionWorld.z]
            np.testing.assert_allclose(place, joints[frame, NAMED[joint.Name]], atol=1e-3, err_msg=joint.Name)


@pytest.mark.parametrize("fps", [10.0, 20.0, 29.97, 30.0, 60.0, 120.0])
def test_every_rate_becomes_twenty(fps):
    count = 31
    line = np.arange(count)[:, None, None] / fps * np.ones((1, 22, 3))  # one metre a second
    ours = at_our_rate(line, fps)
    np.testing.assert_allclose(ours[:, 0, 0], np.arange(len(ours)) / 20, atol=1e-9)
    assert (len(ours) - 1) / 20 <= (count - 1) / fps + 1e-3 < len(ours) / 20 + 1e-3


@needs_reference
@pytest.mark.parametrize("path", sorted(REFERENCE.glob("*.bvh")), ids=lambda path: path.stem)
def test_reference_files_become_standing_people(path):
    bvh = read_bvh(path)
    joints = to_joints(bvh)
    seconds = (len(bvh.frames) - 1) * bvh.frame_time
    assert abs((len(joints) - 1) / 20 - seconds) <= 0.05
    lengths = np.linalg.norm(joints - joints[:, list(PARENTS)], axis=-1)
    np.testing.assert_allclose(lengths[:, 1:], np.broadcast_to(BONE_LENGTHS[1:], lengths[:, 1:].shape), atol=1e-6)
    assert joints[..., 1].min() == pytest.approx(0, abs=1e-9) and 0.7 < joints[0, 0, 1] < 1.1
    assert joints[0, NAMED["left_hip"], 0] > 0 > joints[0, NAMED["right_hip"], 0]  # facing +Z, left is +X
    assert joints[0, NAMED["head"], 1] > joints[0, NAMED["neck"], 1] > joints[0, NAMED["pelvis"], 1]
    toes = [joints[0, NAMED[f"{side}_foot"], 2] - joints[0, NAMED[f"{side}_ankle"], 2] for side in ("left", "right")]
    assert max(toes) > 0.05  # forward, of the foot that stands


@needs_reference
@pytest.mark.parametrize(("name", "side", "other"), [("left", "left", "right"), ("right", "right", "left")])
def test_left_stays_left(name, side, other):
    (path,) = REFERENCE.glob(f"*wave-{name}-hand*.bvh")
    joints = to_joints(read_bvh(path))
    height = {hand: joints[:, NAMED[f"{hand}_wrist"], 1].max() for hand in (side, other)}
    assert height[side] > height[other] + 0.3
    turned = to_joints(read_bvh(path), up="y")
    np.testing.assert_array_equal(turned, joints)


@needs_reference
def test_z_up_is_the_same_person():
    bvh = read_bvh(next(iter(sorted(REFERENCE.glob("*walk_normal*")))))
    names, parents = ["world", *bvh.names], [-1, *(p + 1 for p in bvh.parents)]
    lying = Bvh(  # the file under a joint that lays y down on z
        names,
        parents,
        np.concatenate([np.zeros((1, 3)), bvh.offsets]),
        [["Xrotation"], *bvh.channels],
        np.concatenate([np.full((len(bvh.frames), 1), 90.0), bvh.frames], axis=1),
        bvh.frame_time,
    )
    np.testing.assert_allclose(to_joints(lying, up="z"), to_joints(bvh), atol=1e-9)
    assert joint_positions(lying)[0, :, 2].max() > 100


def test_a_map_is_found_behind_a_prefix_and_its_absence_is_said():
    mixamo = [f"mixamorig:{name}" for name in ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")]
    for side in ("Left", "Right"):
        parts = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
        mixamo += [f"mixamorig:{side}{part}" for part in parts]
    assert find_map(mixamo)["left_knee"] == "mixamorig:LeftLeg"
    with pytest.raises(ValueError, match="smpl, bandai-namco, mixamo fits"):
        find_map(["a", "b"])


GOOD = """HIERARCHY
ROOT a
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT b
  {
    OFFSET 0 1 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.05
0 0 0 0 0 0 0 0 0
0 1 0 90 0 0 0 0 0
"""
SPOILT = [
    (("Frames: 2", "Frames: 3"), "says that it has 3 frames, and 2 lines"),
    (("Frames: 2", "Frames: many"), "no number: 'many'"),
    (("0 1 0 90 0 0 0 0 0", "0 1 0 90 0 0 0 0"), "frame 1 has 8 numbers"),
    (("0 1 0 90", "0 1 0 x"), "no number"),
    (("0 1 0 90", "0 1 0 nan"), "frame 1 holds a NaN"),
    (("HIERARCHY", "HIERARCHIE"), "no BVH file"),
    (("MOTION", "MOTIVE"), "no BVH file"),
    (("Frame Time: 0.05", "Frame Time: 0"), "from 0.0001 to 10 s"),
    (
        ("Zrotation Xrotation Yrotation\n    End", "Zrotation Wrotation Yrotation\n    End"),
        "unknown channel 'Wrotation'",
    ),
    (("CHANNELS 3", "CHANNELS 4"), "unknown channel"),
    (("OFFSET 0 1 0\n    CHANNELS", "OFFSET 0 one 0\n    CHANNELS"), "OFFSET is no number"),
    (("  }\n}\nMOTION", "  }\nMOTION"), "closed braces"),
    (("ROOT a", "TREE a"), "'TREE' was not expected"),
]


def test_the_good_file_is_read(tmp_path):
    (tmp_path / "a.bvh").write_text(GOOD)
    bvh = read_bvh(tmp_path / "a.bvh")
    np.testing.assert_allclose(joint_positions(bvh)[1], [[0, 1, 0], [-1, 1, 0]], atol=1e-12)


@pytest.mark.parametrize(("change", "said"), SPOILT)
def test_a_file_that_lies_is_refused_with_the_place(change, said, tmp_path):
    assert change[0] in GOOD
    (tmp_path / "a.bvh").write_text(GOOD.replace(*change))
    with pytest.raises(ValueError, match=said):
        read_bvh(tmp_path / "a.bvh")
