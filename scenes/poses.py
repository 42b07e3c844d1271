"""Rigid poses as float64 `[..., 4, 4]` matrices: quaternions, inverse, interpolation, small motions."""

import math

import numpy as np
import torch

CAM_FROM_FLU = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
"""From axes that look forward, left and up to a camera's, which look right, down and forward."""


def as_pose(value) -> torch.Tensor:
    """A float64 pose `[..., 4, 4]` from a tensor or anything numpy reads; that it is rigid is the caller's word."""
    pose = value if isinstance(value, torch.Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
    if pose.shape[-2:] != (4, 4):
        raise ValueError(f"a pose must have shape (..., 4, 4), got {tuple(pose.shape)}")
    return pose.to(torch.float64)


def matrix_from_quat(quat: torch.Tensor) -> torch.Tensor:
    """Rotation `[..., 3, 3]` from quaternions wxyz `[..., 4]` of any positive length."""
    w, x, y, z = (quat / quat.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quat.shape[:-1], 3, 3)


def nearest_rotation(matrix: torch.Tensor) -> torch.Tensor:
    """The rotations `[..., 3, 3]` nearest to matrices that are nearly some (Higham 1986, by SVD)."""
    u, _, v = torch.linalg.svd(matrix)
    last = torch.det(u @ v).sign()
    flip = torch.stack([torch.ones_like(last), torch.ones_like(last), last], -1)
    return (u * flip[..., None, :]) @ v


def unturned(pose: torch.Tensor) -> torch.Tensor:
    """What R R^T of poses `[..., 4, 4]` differs by from the unit matrix, `[..., 3, 3]`: 0 where they only move and turn, or mirror."""
    turn = pose[..., :3, :3]
    return turn @ turn.mT - torch.eye(3, dtype=pose.dtype, device=pose.device)


def quat_from_matrix(rotation: torch.Tensor) -> torch.Tensor:
    """Unit quaternions wxyz `[..., 4]`, w >= 0, from rotations `[..., 3, 3]` (Shepperd's method: the largest term leads)."""
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    trace = xx + yy + zz
    # 4 times the products of the quaternion's terms
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    squares = torch.stack([trace, xx, yy, zz], -1)
    candidates = torch.stack(
        [
            torch.stack([1 + trace, wx, wy, wz], -1),
            torch.stack([wx, 1 + 2 * xx - trace, xy, xz], -1),
            torch.stack([wy, xy, 1 + 2 * yy - trace, yz], -1),
            torch.stack([wz, xz, yz, 1 + 2 * zz - trace], -1),
        ],
        -2,
    )
    lead = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quat = candidates.gather(-2, lead).squeeze(-2)
    quat = quat / quat.norm(dim=-1, keepdim=True)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def quat_product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Quaternions wxyz `[..., 4]` that turn by `b`, then by `a` (Hamilton's product)."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    terms = [
        aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
    ]  # fmt: skip
    return torch.stack(terms, -1)


def pose_from(quat, translation) -> torch.Tensor:
    """Pose `[..., 4, 4]` from a quaternion wxyz `[..., 4]` and a translation `[..., 3]`."""
    quat, translation = (torch.as_tensor(v, dtype=torch.float64) for v in (quat, translation))
    top = torch.cat([matrix_from_quat(quat), translation[..., None]], -1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=top.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def translation(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> torch.Tensor:
    """The pose that only moves."""
    return pose_from([1.0, 0.0, 0.0, 0.0], [x, y, z])


def yaw(angle: float) -> torch.Tensor:
    """The pose that turns by `angle` radians about z, counter-clockwise seen from above."""
    return pose_from([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)], [0.0, 0.0, 0.0])


def yaw_of(pose: torch.Tensor) -> torch.Tensor:
    """Heading in radians of the pose's x axis in the xy plane."""
    return torch.atan2(pose[..., 1, 0], pose[..., 0, 0])


def inverse(pose: torch.Tensor) -> torch.Tensor:
    """The inverse of rigid poses `[..., 4, 4]`, exact up to rounding (no general matrix inverse)."""
    back = pose[..., :3, :3].transpose(-1, -2)
    top = torch.cat([back, -back @ pose[..., :3, 3:]], -1)
    return torch.cat([top, pose[..., 3:, :]], -2)


def slerp(a: torch.Tensor, b: torch.Tensor, u) -> torch.Tensor:
    """Spherical interpolation of quaternions wxyz along the shorter arc; `u` outside [0, 1] extrapolates (Shoemake 1985)."""
    a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
    u = torch.as_tensor(u, dtype=a.dtype, device=a.device)[..., None]
    b = torch.where((a * b).sum(-1, keepdim=True) < 0, -b, b)
    # atan2 of the half chord keeps full precision at small angles, where acos(dot) loses half the digits
    angle = 2 * torch.atan2((b - a).norm(dim=-1, keepdim=True), (b + a).norm(dim=-1, keepdim=True))
    small = angle < 1e-12
    safe = torch.where(small, torch.ones_like(angle), angle)
    wa = torch.where(small, 1 - u, torch.sin((1 - u) * safe) / torch.sin(safe))
    wb = torch.where(small, u.expand_as(wa), torch.sin(u * safe) / torch.sin(safe))
    return wa * a + wb * b


def interpolate(a: torch.Tensor, b: torch.Tensor, u) -> torch.Tensor:
    """Pose between `a` (u = 0) and `b` (u = 1): slerp of the rotation, lerp of the position."""
    u = torch.as_tensor(u, dtype=torch.float64, device=a.device)
    quat = slerp(quat_from_matrix(a[..., :3, :3]), quat_from_matrix(b[..., :3, :3]), u)
    return pose_from(quat, a[..., :3, 3] + u[..., None] * (b[..., :3, 3] - a[..., :3, 3]))


_GENERATORS = torch.zeros(6, 4, 4, dtype=torch.float64)
"""Of SE(3): rotations about the three axes, then translations along them."""
for _axis, (_i, _j) in enumerate(((2, 1), (0, 2), (1, 0))):
    _GENERATORS[_axis, _i, _j], _GENERATORS[_axis, _j, _i], _GENERATORS[3 + _axis, _axis, 3] = 1, -1, 1

_POWERS = torch.arange(20, dtype=torch.float64)
_SERIES = torch.tensor([[(-1) ** k / math.factorial(2 * k + n) for n in (2, 3)] for k in range(20)], dtype=torch.float64)
"""Taylor series of (1 - cos a) / a^2 and (a - sin a) / a^3 in a^2: exact to float64's last digits up to a whole turn, and smooth at 0."""


def small_poses(deltas: torch.Tensor) -> torch.Tensor:
    """Poses `[..., 4, 4]` of small motions `[..., 6]`: rotation vector (radians, less than a turn), then translation (metres), by the
    exponential map, which of such a matrix is a cubic (Rodrigues' formula)."""
    deltas = deltas.to(torch.float64)
    once = (deltas @ _GENERATORS.flatten(1)).unflatten(-1, (4, 4))
    twice = once @ once
    square = deltas[..., :3].square().sum(-1, keepdim=True)
    second, third = (square**_POWERS @ _SERIES)[..., None, None].unbind(-3)
    return torch.eye(4, dtype=torch.float64) + once + second * twice + third * (twice @ once)
