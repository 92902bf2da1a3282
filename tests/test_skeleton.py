"""The body and the rotation algebra, against scipy and against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from minicmdm.data import skeleton as sk


def random_quats(seed, *shape):
    q = np.random.default_rng(seed).normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def scipy_of(q):
    return Rotation.from_quat(np.roll(q, -1, axis=-1))  # scipy writes x, y, z, w


def test_tree_is_a_tree_and_sides_pair_up():
    assert sk.NUM_JOINTS == len(set(sk.JOINT_NAMES)) == len(sk.PARENTS) == len(sk.BONE_LENGTHS) == 22
    assert all(parent < joint for joint, parent in enumerate(sk.PARENTS))
    for left, right in sk.LEFT_RIGHT:
        assert sk.JOINT_NAMES[left].replace("left", "right") == sk.JOINT_NAMES[right]
        assert sk.MIRROR[sk.PARENTS[left]] == sk.PARENTS[right]
    assert np.array_equal(sk.MIRROR[sk.MIRROR], np.arange(22))
    reached = sorted(joint for chain in sk.CHAINS for joint in chain[1:])
    assert reached == list(range(1, 22))
    assert all(sk.PARENTS[b] == a for chain in sk.CHAINS for a, b in zip(chain, chain[1:], strict=False))


def test_rest_pose_has_left_at_plus_x_and_head_above_feet():
    rest = sk.forward_kinematics(np.tile([1.0, 0, 0, 0], (22, 1)), np.zeros(3))
    for left, right in sk.LEFT_RIGHT:
        assert rest[left, 0] > 0 > rest[right, 0]
    assert rest[15, 1] > rest[0, 1] > rest[10, 1]
    assert rest[10, 2] > rest[7, 2] and rest[11, 2] > rest[8, 2]  # toes point forward, to +Z


def test_quaternions_agree_with_scipy():
    p, q = random_quats(0, 5, 7), random_quats(1, 5, 7)
    v = np.random.default_rng(2).normal(size=(5, 7, 3))
    for got, want in [
        (sk.quat_to_matrix(p), scipy_of(p.reshape(-1, 4)).as_matrix().reshape(5, 7, 3, 3)),
        (
            sk.quat_to_matrix(sk.quat_multiply(p, q)),
            (scipy_of(p.reshape(-1, 4)) * scipy_of(q.reshape(-1, 4))).as_matrix().reshape(5, 7, 3, 3),
        ),
        (sk.quat_rotate(p, v), scipy_of(p.reshape(-1, 4)).apply(v.reshape(-1, 3)).reshape(5, 7, 3)),
        (sk.quat_rotate(sk.quat_inverse(p), sk.quat_rotate(p, v)), v),
    ]:
        np.testing.assert_allclose(got, want, atol=1e-12)


def test_axis_angle_and_yaw_turn_z_to_the_left():
    axis = np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(sk.quat_from_axis_angle(axis, 0.7), sk.quat_yaw(0.7))
    assert sk.quat_from_axis_angle(axis, np.zeros((3, 2))).shape == (3, 2, 4)
    np.testing.assert_allclose(sk.quat_rotate(sk.quat_yaw(np.pi / 2), [0, 0, 1.0]), [1, 0, 0], atol=1e-15)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_between_is_the_shortest_rotation(seed):
    u, v = np.random.default_rng(seed).normal(size=(2, 3))
    q = sk.quat_between(u, v)
    np.testing.assert_allclose(sk.quat_rotate(q, sk.normalize(u)), sk.normalize(v), atol=1e-9)
    angle = np.arccos(np.clip(sk.normalize(u) @ sk.normalize(v), -1, 1))
    assert q[0] >= 0 and np.isclose(2 * np.arctan2(np.linalg.norm(q[1:]), q[0]), angle, atol=1e-6)


@pytest.mark.parametrize("u", [*np.eye(3), *-np.eye(3)])
def test_between_survives_opposite_and_zero_vectors(u):
    np.testing.assert_allclose(sk.quat_rotate(sk.quat_between(u, -u), u), -u, atol=1e-12)
    np.testing.assert_allclose(sk.quat_between(u, np.zeros(3)), [1, 0, 0, 0])


def test_matrix_and_6d_round_trips():
    q = np.concatenate([random_quats(3, 200), np.eye(4)])  # half turns have no trace to divide by
    q = np.where(q[..., :1] < 0, -q, q)
    matrix = sk.quat_to_matrix(q)
    np.testing.assert_allclose(sk.quat_to_matrix(sk.matrix_to_quat(matrix)), matrix, atol=1e-12)
    np.testing.assert_allclose(sk.sixd_to_matrix(sk.matrix_to_6d(matrix)), matrix, atol=1e-12)
    np.testing.assert_allclose(sk.matrix_to_6d(matrix)[..., :3], matrix @ [1.0, 0, 0], atol=1e-12)  # a column


def test_6d_of_anything_is_a_rotation():
    matrix = sk.sixd_to_matrix(np.random.default_rng(4).normal(size=(50, 6)) * 3)
    np.testing.assert_allclose(
        matrix @ np.swapaxes(matrix, -1, -2), np.broadcast_to(np.eye(3), matrix.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(matrix), 1)


def test_forward_kinematics_agrees_with_walking_the_tree_joint_by_joint():
    rotations, root = random_quats(5, 3, 22), np.random.default_rng(6).normal(size=(3, 3))
    joints = sk.forward_kinematics(rotations, root)
    for t in range(3):
        world = [scipy_of(rotations[t, 0])]
        want = [root[t]]
        for j in range(1, 22):
            parent = sk.PARENTS[j]
            want.append(want[parent] + world[parent].apply(sk.REST_OFFSETS[j].copy()))
            world.append(world[parent] * scipy_of(rotations[t, j]))
        np.testing.assert_allclose(joints[t], want, atol=1e-12)
    bones = np.linalg.norm(joints[:, 1:] - joints[:, list(sk.PARENTS[1:])], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(sk.BONE_LENGTHS[1:], bones.shape), atol=1e-12)


def test_forward_kinematics_says_what_it_wants():
    with pytest.raises(ValueError, match=r"\(\.\.\., 22, 4\).*\(22, 3\)"):
        sk.forward_kinematics(np.zeros((22, 3)), np.zeros(3))
