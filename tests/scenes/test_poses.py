import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from randomized import poses

from scenes.poses import (
    as_pose,
    interpolate,
    inverse,
    matrix_from_quat,
    nearest_rotation,
    pose_from,
    quat_from_matrix,
    slerp,
    small_poses,
    translation,
    yaw,
    yaw_of,
)  # fmt: skip

EYE = torch.eye(4, dtype=torch.float64)
numbers = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: max(map(abs, q)) > 1e-3)
quats = numbers.map(lambda q: torch.tensor(q, dtype=torch.float64))


def close(a, b, tolerance=1e-14):
    return float((a - b).abs().max()) <= tolerance


@given(quats)
def test_a_quaternion_returns_from_its_matrix_up_to_sign(q):
    back, unit = quat_from_matrix(matrix_from_quat(q)), q / q.norm()
    assert back[0] >= 0 and (close(back, unit) or close(back, -unit))


@given(quats, st.floats(1e-3, 1e3))
def test_a_matrix_is_a_rotation_whatever_the_quaternions_length(q, length):
    turn = matrix_from_quat(q * length)
    assert close(turn @ turn.T, torch.eye(3)) and close(turn, matrix_from_quat(q)) and torch.linalg.det(turn) > 0


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_return(axis):
    q = torch.zeros(4, dtype=torch.float64)
    q[1 + axis] = 1
    for tilt in (0.0, 1e-9, -1e-9):
        near = q + torch.tensor([tilt, 0, 0, 0])
        assert close(matrix_from_quat(quat_from_matrix(matrix_from_quat(near))), matrix_from_quat(near))


def test_batches_agree_with_single_quaternions():
    turns = poses(50)[:, :3, :3]
    assert close(quat_from_matrix(turns), torch.stack([quat_from_matrix(t) for t in turns]), 0)


def test_poses_form_a_group():
    a, b, c = poses(3, spread=1.0)
    assert close((a @ b) @ c, a @ (b @ c)) and close(inverse(a) @ a, EYE) and close(a @ inverse(a), EYE)
    assert close(inverse(a @ b), inverse(b) @ inverse(a))


def test_yaw_turns_left_and_reads_back():
    for angle in (-3.0, -0.5, 0.0, 1.0, 3.1):
        assert float(yaw_of(yaw(angle))) == pytest.approx(angle)
    assert close((yaw(math.pi / 2) @ torch.tensor([1.0, 0, 0, 1]).double())[:3], torch.tensor([0.0, 1, 0]).double())


@given(quats, quats, st.floats(0, 1), st.floats(0, 1))
def test_slerp_turns_at_a_constant_rate(a, b, u, v):
    unit_a, unit_b = a / a.norm(), b / b.norm()
    if abs(float(unit_a @ unit_b)) < 1e-6:
        return  # opposite rotations have no shorter arc
    whole = 2 * math.acos(min(1.0, abs(float(unit_a @ unit_b))))
    part = 2 * math.acos(min(1.0, abs(float(slerp(a, b, u) @ slerp(a, b, v)))))
    assert part == pytest.approx(abs(u - v) * whole, abs=1e-6)


def test_slerp_meets_its_ends_takes_the_shorter_arc_and_ignores_signs():
    a, b = torch.tensor([1.0, 0, 0, 0]).double(), pose_quat(2.0)
    assert close(slerp(a, b, 0.0), a) and close(slerp(a, b, 1.0), b)
    assert close(matrix_from_quat(slerp(a, -b, 0.5)), matrix_from_quat(slerp(a, b, 0.5)))
    assert close(slerp(a, pose_quat(1e-9), 0.5), pose_quat(5e-10), 1e-24)


def pose_quat(angle):
    return torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=torch.float64)


def test_interpolation_commutes_with_a_move_of_the_world():
    world, a, b = poses(3, 5, 10.0)
    # u p + (1 - u) p of positions commutes because rotations are linear; slerp because it is relative
    assert close(interpolate(world @ a, world @ b, 0.3), world @ interpolate(a, b, 0.3), 1e-12)


def test_interpolation_is_the_same_backwards():
    a, b = poses(2, 9)
    assert close(interpolate(a, b, 0.2), interpolate(b, a, 0.8), 1e-12)
    assert close(interpolate(a, b, 0.0), a, 1e-12) and close(interpolate(a, b, 1.0), b, 1e-12)


def test_numpy_and_lists_become_float64_poses():
    assert as_pose(np.eye(4, dtype=np.float32)).dtype == as_pose(EYE.tolist()).dtype == torch.float64
    assert close(translation(1, 2, 3)[:3, 3], torch.tensor([1.0, 2, 3]).double(), 0)
    assert close(pose_from([2.0, 0, 0, 0], [0, 0, 0]), EYE, 0)
    with pytest.raises(ValueError, match=r"must have shape \(..., 4, 4\), got \(3, 4\)"):
        as_pose(np.zeros((3, 4)))


def test_the_nearest_rotation_mirrors_nothing():
    generator = torch.Generator().manual_seed(3)
    near = nearest_rotation(torch.randn(40, 3, 3, generator=generator, dtype=torch.float64))
    assert torch.allclose(torch.linalg.det(near), torch.ones(40, dtype=torch.float64))
    assert torch.allclose(near @ near.mT, torch.eye(3, dtype=torch.float64).expand(40, 3, 3), rtol=0, atol=1e-12)
    turn = yaw(0.7)[:3, :3]
    assert torch.allclose(nearest_rotation(1.3 * turn), turn, rtol=0, atol=1e-14)


def test_small_poses_are_the_exponential_map():
    delta = torch.tensor([[0.0, 0.0, 0.3, 1.0, 2.0, 3.0], [0.0] * 6])
    poses = small_poses(delta)
    torch.testing.assert_close(poses[1], torch.eye(4, dtype=torch.float64))
    assert float(torch.atan2(poses[0, 1, 0], poses[0, 0, 0])) == pytest.approx(0.3, abs=1e-6)
    torch.testing.assert_close(small_poses(-delta[0]) @ poses[0], torch.eye(4, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.02, 1.0, math.pi - 1e-9, math.pi, 6.2])
def test_small_poses_and_their_gradients_are_those_of_the_matrix_exponential(angle):
    generator = torch.Generator().manual_seed(2)
    deltas, weights = (torch.randn(20, *shape, dtype=torch.float64, generator=generator) for shape in ((6,), (4, 4)))
    deltas[:, :3] *= angle / deltas[:, :3].norm(dim=1, keepdim=True)
    deltas.requires_grad_()
    found = small_poses(deltas)
    x, y, z, *moved = deltas.unbind(1)
    o = torch.zeros_like(x)
    rows = ([o, -z, y, moved[0]], [z, o, -x, moved[1]], [-y, x, o, moved[2]], [o] * 4)
    exact = torch.linalg.matrix_exp(torch.stack([torch.stack(row, 1) for row in rows], 1))
    torch.testing.assert_close(found, exact, atol=1e-13, rtol=0)
    slopes = [torch.autograd.grad((poses * weights).sum(), deltas, retain_graph=True)[0] for poses in (found, exact)]
    torch.testing.assert_close(*slopes, atol=1e-12, rtol=0)
