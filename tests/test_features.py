"""The 263 features: against the published clip, against closed forms, and as properties of any motion."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from minicmdm.data import features as ft
from minicmdm.data import skeleton as sk

REFERENCE = Path(__file__).resolve().parents[2] / "shared" / "reference" / "humanml3d"
needs_reference = pytest.mark.skipif(
    not REFERENCE.is_dir(),
    reason=f"the HumanML3D reference clip is not at {REFERENCE} (it may not be shipped)",
)


def smooth_motion(seed=0, frames=61, turning=0.0):
    """A body that sways every joint, wanders and may turn steadily: (frames, 22, 3)."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None, None] / sk.FPS
    sway = 0.3 * np.sin(2 * np.pi * rng.uniform(0.2, 1, (22, 3)) * t + rng.uniform(0, 6, (22, 3)))  # (T, 22, 3) rad
    angle = np.linalg.norm(sway, axis=-1)
    local = sk.quat_from_axis_angle(sway / angle[..., None], angle)
    local[:, 0] = sk.quat_multiply(sk.quat_yaw(turning * t[:, 0, 0] + rng.uniform(-3, 3)), local[:, 0])
    path = np.concatenate([t[:, 0] * 1.1, 0.95 + 0.05 * np.sin(6 * t[:, 0]), 0.4 * np.cos(t[:, 0])], axis=-1)
    return sk.forward_kinematics(local, path + rng.normal(size=3) * [2, 0, 2])


def turned(joints, yaw, shift=(0.0, 0.0, 0.0)):
    return ft.turn(joints, np.full(len(joints), yaw)) + np.array(shift)


@pytest.fixture(scope="module")
def published():
    """Joints (T+1, 22, 3) and features (T, 263) of clip 012314; the lost last frame is in the last row."""
    vectors = np.load(REFERENCE / "012314_vecs.npy").astype(np.float64)
    joints = np.load(REFERENCE / "012314_joints.npy").astype(np.float64)
    yaw = -2 * vectors[:-1, 0].sum(keepdims=True)
    last = joints[-1:] + ft.turn(vectors[-1:, ft.VELOCITIES].reshape(1, 22, 3), yaw)
    return np.concatenate([joints, last]), vectors


@needs_reference
def test_released_recipe_reproduces_the_published_clip(published):
    joints, vectors = published
    error = np.abs(ft.joints_to_features(joints, heading="humanml3d") - vectors)
    assert error[:, ft.ROTATIONS].max() < 5e-5
    assert error[:, :67].max() < 5e-6 and error[:, ft.VELOCITIES].max() < 5e-6
    squared = (np.diff(joints[:, ft.CONTACT_JOINTS], axis=0) ** 2).sum(-1)
    assert not error[:, ft.CONTACTS][np.abs(squared - ft.CONTACT_THRESHOLD) > 1e-6].any()


@needs_reference
def test_recovery_reproduces_the_published_joints(published):
    joints, vectors = published
    np.testing.assert_allclose(ft.features_to_joints(vectors), joints[:-1], atol=1e-6)


@needs_reference
def test_corrected_heading_mends_the_jump_of_the_first_row(published):
    joints, _ = published
    released = np.abs(ft.joints_to_features(joints, heading="humanml3d")[:, 0])
    corrected = np.abs(ft.joints_to_features(joints)[:, 0])
    assert released[0] > 10 * released[1] and corrected[0] < 2 * corrected[1]


def test_hips_are_the_true_ones():
    joints = smooth_motion(3)
    swapped = joints.copy()
    swapped[:, [1, 2]] = joints[:, [2, 1]]
    assert np.abs(ft.facing_yaw(swapped) - ft.facing_yaw(joints)).max() > 0.01
    released = ft.joints_to_features(joints, heading="humanml3d")
    assert np.abs(released[:, ft.POSITIONS] - ft.joints_to_features(joints)[:, ft.POSITIONS]).max() > 0.01
    # A twist of the hips alone turns the true heading with them, the released one against them.
    rest = sk.forward_kinematics(np.tile([1.0, 0, 0, 0], (3, 22, 1)), np.zeros((3, 3)))
    rest[:, [1, 2]] = ft.turn(rest[:, [1, 2]], np.full(3, 0.5))
    assert ft.facing_yaw(rest)[1] > 0.1 and ft.released_yaw(rest)[1] < -0.1


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 200), st.floats(-9, 9))
def test_joints_survive_the_round_trip(seed, frames, turning):
    joints = smooth_motion(seed, frames, turning)
    recovered = ft.features_to_joints(ft.joints_to_features(joints))
    np.testing.assert_allclose(recovered, ft.canonicalize(joints)[:-1], atol=1e-9)
    assert np.abs(recovered[0, 0, [0, 2]]).max() == 0 and abs(ft.facing_yaw(recovered)[0]) < 1e-9


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 120), st.floats(-7, 7), st.floats(-5, 5))
def test_turning_or_moving_the_whole_motion_changes_nothing(seed, frames, yaw, shift):
    joints = smooth_motion(seed, frames)
    want = ft.joints_to_features(joints)
    got = ft.joints_to_features(turned(joints, yaw, (shift, 0.0, -2 * shift)))
    np.testing.assert_allclose(got[:, :259], want[:, :259], atol=1e-9)
    step = (np.diff(joints[:, ft.CONTACT_JOINTS], axis=0) ** 2).sum(-1)
    assert np.array_equal(got[:, 259:], want[:, 259:]) or np.abs(step - 0.002).min() < 1e-9


def test_features_of_features_are_the_same_features():
    features = ft.joints_to_features(smooth_motion(7, 90))
    again = ft.joints_to_features(ft.features_to_joints(features))
    # Rows near the end see a shorter smoothing window; what is not smoothed away must agree.
    np.testing.assert_allclose(ft.features_to_joints(again), ft.features_to_joints(features)[:-1], atol=1e-9)


@pytest.mark.parametrize("turning", [-8.0, -1.0, 1.0, 8.0])  # rad/s; 8 is over a turn a second
def test_half_angle_of_a_steady_turn_is_exact_from_the_first_row_to_the_last(turning):
    rest = sk.forward_kinematics(np.tile([1.0, 0, 0, 0], (120, 22, 1)), np.zeros((120, 3)))
    joints = ft.turn(rest, turning * np.arange(120) / sk.FPS)
    angular = ft.joints_to_features(joints)[:, 0]
    np.testing.assert_allclose(angular, -turning / sk.FPS / 2, atol=1e-12)  # left is negative, and half
    # The released recipe meets its sign fault each time the heading passes 180 degrees.
    if abs(turning) > 1:
        assert (np.sign(ft.joints_to_features(joints, heading="humanml3d")[1:, 0]) == np.sign(turning)).any()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 250))
def test_smoothing_keeps_both_ends_and_straight_lines(seed, frames):
    yaw = np.cumsum(np.random.default_rng(seed).normal(size=frames))
    smooth = ft.smooth_yaw(yaw)
    assert smooth.shape == yaw.shape
    np.testing.assert_allclose(smooth[[0, -1]], yaw[[0, -1]], atol=1e-9)
    line = 0.3 + 0.7 * np.arange(frames)
    np.testing.assert_allclose(ft.smooth_yaw(line), line, atol=1e-9)


def test_smoothing_is_the_gaussian_of_the_oddly_reflected_angle():
    from scipy.ndimage import gaussian_filter1d

    yaw = np.cumsum(np.random.default_rng(0).normal(size=150))
    padded = np.concatenate([2 * yaw[0] - yaw[80:0:-1], yaw, 2 * yaw[-1] - yaw[-2:-82:-1]])
    np.testing.assert_allclose(ft.smooth_yaw(yaw), gaussian_filter1d(padded, 20)[80:-80], atol=1e-12)


def test_columns_hold_what_their_names_say():
    joints = smooth_motion(11, 41)
    features = ft.joints_to_features(joints)
    yaw = ft.smooth_yaw(ft.facing_yaw(joints))
    t = 17
    local = ft.turn(joints[t], -yaw[t])
    np.testing.assert_allclose(features[t, 3], joints[t, 0, 1])
    np.testing.assert_allclose(features[t, ft.POSITIONS].reshape(21, 3), local[1:] - local[0] * [1, 0, 1], atol=1e-12)
    step = ft.turn(joints[t + 1, 0] - joints[t, 0], -yaw[t + 1])  # the next heading
    np.testing.assert_allclose(features[t, ft.ROOT_LINEAR], step[[0, 2]], atol=1e-12)
    velocity = ft.turn(joints[t + 1] - joints[t], -yaw[t])  # this heading
    np.testing.assert_allclose(features[t, ft.VELOCITIES].reshape(22, 3), velocity, atol=1e-12)


def test_6d_block_rebuilds_every_bone():
    joints = smooth_motion(5, 21)
    features = ft.joints_to_features(joints)
    local = sk.sixd_to_matrix(features[:, ft.ROTATIONS].reshape(-1, 21, 6))
    np.testing.assert_allclose(sk.matrix_to_6d(local).reshape(-1, 126), features[:, ft.ROTATIONS], atol=1e-12)
    seen = ft.turn(joints, -ft.smooth_yaw(ft.facing_yaw(joints)))[:-1]
    for chain in sk.CHAINS:
        world = np.eye(3)
        for parent, joint in zip(chain, chain[1:], strict=False):
            world = world @ local[:, joint - 1]
            bone = world @ sk.RAW_DIRECTIONS[joint] * sk.BONE_LENGTHS[joint]
            np.testing.assert_allclose(bone, seen[:, joint] - seen[:, parent], atol=1e-9)


def test_contacts_mark_slow_feet_in_the_released_order():
    joints = np.repeat(sk.forward_kinematics(np.tile([1.0, 0, 0, 0], (1, 22, 1)), np.zeros((1, 3))), 5, axis=0)
    joints[:, 10, 0] += 0.0446 * np.arange(5)  # left foot just slow enough
    joints[:, 8, 0] += 0.0448 * np.arange(5)  # right ankle just too fast
    assert np.array_equal(ft.joints_to_features(joints)[:, ft.CONTACTS], np.tile([1, 1, 0, 1], (4, 1)))


def test_views_and_dtypes():
    features = ft.joints_to_features(smooth_motion(2).astype(np.float32))
    assert features.dtype == np.float32 and features.shape == (60, 263)
    assert np.shares_memory(ft.essential(features), features) and ft.essential(features).shape == (60, 67)
    joints = ft.features_to_joints(features)
    assert joints.dtype == np.float32
    assert np.array_equal(ft.features_to_joints(ft.essential(features)), joints)
    assert np.array_equal(ft.coordinates(features), joints.reshape(60, 66))
    batch = np.stack([features, features[::-1]])
    np.testing.assert_allclose(ft.features_to_joints(batch)[0], joints, atol=1e-6)


def test_retarget_sets_lengths_keeps_directions_and_scales_the_path():
    joints = smooth_motion(4)
    small = ft.retarget(joints, sk.BONE_LENGTHS * np.linspace(0.5, 0.8, 22))
    back = ft.retarget(small)
    bones = back[:, 1:] - back[:, list(sk.PARENTS[1:])]
    np.testing.assert_allclose(np.linalg.norm(bones, axis=-1), np.tile(sk.BONE_LENGTHS[1:], (61, 1)), atol=1e-12)
    np.testing.assert_allclose(back, joints, atol=1e-9)  # same directions, and the path scaled there and back
    legs = small[:, [5, 8]] - small[:, [2, 5]]
    ratio = np.linalg.norm(legs[0], axis=-1).sum() / sk.BONE_LENGTHS[[5, 8]].sum()
    np.testing.assert_allclose(small[:, 0], joints[:, 0] * ratio, atol=1e-9)


def test_bones_get_their_length_back_where_the_body_stands():
    """What a generated motion needs: frame by frame, with no frame 0 that scales the path, so a stream may use it."""
    joints = smooth_motion(4)
    wrong = joints + np.random.default_rng(0).normal(0, 0.01, joints.shape)
    rigid = ft.retarget(wrong, scale_path=False)
    np.testing.assert_allclose(rigid[:, 0], wrong[:, 0], atol=1e-12)
    bones = rigid[:, 1:] - rigid[:, list(sk.PARENTS[1:])]
    np.testing.assert_allclose(np.linalg.norm(bones, axis=-1), np.tile(sk.BONE_LENGTHS[1:], (61, 1)), atol=1e-12)
    np.testing.assert_allclose(
        np.concatenate([ft.retarget(one[None], scale_path=False) for one in wrong]), rigid, atol=1e-12
    )
    np.testing.assert_allclose(ft.retarget(joints, scale_path=False), joints, atol=1e-9)


def test_canonical_motion_starts_at_the_origin_facing_z():
    joints = smooth_motion(9, turning=1.0)
    canonical = ft.canonicalize(joints)
    assert np.abs(canonical[0, 0, [0, 2]]).max() < 1e-12 and abs(ft.facing_yaw(canonical)[0]) < 1e-12
    np.testing.assert_allclose(canonical[..., 1], joints[..., 1])
    assert abs(ft.canonicalize(joints, floor=True)[..., 1].min()) < 1e-12
    np.testing.assert_allclose(ft.canonicalize(canonical), canonical, atol=1e-12)
    bones = np.diff(ft.canonicalize(joints * 1.3, retarget=True)[:, [1, 4]], axis=1)
    np.testing.assert_allclose(np.linalg.norm(bones, axis=-1), sk.BONE_LENGTHS[4], atol=1e-12)


def test_mirror_twice_is_identity_and_once_turns_the_other_way():
    joints = smooth_motion(6, turning=2.0)
    mirrored = ft.mirror_joints(joints)
    assert np.array_equal(ft.mirror_joints(mirrored), joints)
    np.testing.assert_allclose(mirrored[:, 20], joints[:, 21] * [-1, 1, 1])
    one, other = ft.joints_to_features(joints), ft.joints_to_features(mirrored)
    np.testing.assert_allclose(other[:, [0, 1]], -one[:, [0, 1]], atol=1e-9)  # turns and sidesteps
    np.testing.assert_allclose(other[:, [2, 3]], one[:, [2, 3]], atol=1e-9)


@pytest.mark.parametrize(
    ("caption", "mirrored"),
    [
        ("A man waves his left hand.", "A man waves his right hand."),
        ("Left foot, then RIGHT foot", "Right foot, then LEFT foot"),
        ("walks clockwise", "walks counterclockwise"),
        ("walks counter-clockwise to the right", "walks clockwise to the left"),
        ("circles anticlockwise", "circles clockwise"),
        ("steps rightwards, leftmost", "steps leftwards, rightmost"),
        ("stands upright under a bright cleft", "stands upright under a bright cleft"),
    ],
)
def test_mirrored_captions(caption, mirrored):
    assert ft.mirror_caption(caption) == mirrored
    if "anti" not in caption and "-" not in caption:
        assert ft.mirror_caption(mirrored) == caption


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda j: ft.joints_to_features(j[:, :20]), r"\(frames, 22, 3\).*\(61, 20, 3\)"),
        (lambda j: ft.joints_to_features(j[:1]), "at least 2 frames.*got 1"),
        (lambda j: ft.joints_to_features(j, heading="north"), "corrected, humanml3d.*'north'"),
        (lambda j: ft.joints_to_features(np.where(np.arange(61)[:, None, None] == 8, np.nan, j)), "frame 8"),
        (lambda j: ft.features_to_joints(np.zeros((5, 262))), "262"),
        (lambda j: ft.features_to_joints(np.zeros((0, 263))), "T >= 1"),
        (lambda j: ft.features_to_joints(np.full((5, 263), np.inf)), "finite"),
        (lambda j: ft.retarget(j * 0), "no direction"),
        (lambda j: ft.retarget(j, -sk.BONE_LENGTHS), "positive"),
        (lambda j: ft.mirror_joints(j[:, :5]), r"\(61, 5, 3\)"),
        (lambda j: ft.canonicalize(j[0]), r"\(22, 3\)"),
    ],
)
def test_errors_teach(call, message):
    with pytest.raises(ValueError, match=message):
        call(smooth_motion())
