"""Poses and lenses as files state them: made rigid, or refused by the file's name before anything is fitted to them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from scenes.poses import nearest_rotation, pose_from, unturned

ROUNDED = 0.01
"""What R R^T of a rotation in a file may be off the unit matrix: numbers of two or three decimals are; other axes and scales are more."""


def rigid(poses: torch.Tensor, where: str) -> torch.Tensor:
    """Poses float64 `[..., 4, 4]` with the rotations that are nearest to those stated, which files round.

    ValueError naming `where` and the first pose that is not finite, scales, shears or mirrors.
    """
    turns, off = poses[..., :3, :3], unturned(poses).abs().amax((-2, -1))
    right = torch.isfinite(poses).all(-1).all(-1) & (off < ROUNDED) & (torch.linalg.det(turns) > 0)
    _check(right, where, "is no rotation and place: it scales, shears, mirrors or is not finite; export it again")
    out = poses.clone()
    out[..., :3, :3] = nearest_rotation(turns)
    return out


def posed(quats: torch.Tensor, places: torch.Tensor, where: str) -> torch.Tensor:
    """Poses float64 `[..., 4, 4]` from quaternions wxyz `[..., 4]` of any length and places `[..., 3]`. ValueError as `rigid` has it."""
    right = torch.isfinite(quats).all(-1) & torch.isfinite(places).all(-1) & (quats.norm(dim=-1) > 1e-6)
    _check(right, where, "is not finite or has no rotation; fetch it again")
    return pose_from(quats, places)


def _check(right: torch.Tensor, where: str, wrong: str) -> None:
    """ValueError naming the first of several poses, bool `[...]`, that is not right."""
    lost = (~right).reshape(-1).nonzero()
    if len(lost):
        raise ValueError(f"{where}: pose{f' {int(lost[0])}' if right.numel() > 1 else ''} {wrong}")


@contextmanager
def stating(where: str) -> Iterator[None]:
    """Lenses and other things that are made of a file's numbers: what is wrong with them is told with `where` they stand."""
    try:
        yield
    except (LookupError, TypeError, ValueError, torch.linalg.LinAlgError) as problem:
        raise ValueError(f"{where}: {problem}") from None
