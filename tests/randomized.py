"""Random splats, poses and scenes for tests of files: every field used, nothing round."""

import math

import torch

from scenes import Actor, Asset, Gaussians, Ground, Pinhole, Placed, RigCamera, Scene, Sky, SplatModel, Trajectory
from scenes.poses import pose_from

START_US = 1_557_539_924_000_017


def poses(count, seed=0, spread=100.0):
    """float64 `[count, 4, 4]`."""
    dice = torch.Generator().manual_seed(seed)
    quats = torch.randn(count, 4, generator=dice, dtype=torch.float64)
    return pose_from(quats, spread * torch.randn(count, 3, generator=dice, dtype=torch.float64))


def gaussians(count=20, coefficients=4, seed=0):
    """Splats whose logits reach beyond +-15 and whose scales run from a tenth of a millimetre to tens of metres."""
    dice = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=dice)

    means, quats, log_scales, logits = 10 * normal(count, 3), 3 * normal(count, 4), 2 * normal(count, 3) - 3, 8 * normal(count)
    return Gaussians(means, quats, log_scales, logits, normal(count, coefficients, 3))


def trajectory(count=12, seed=0):
    return Trajectory(START_US + 100_003 * torch.arange(count), poses(count, seed))


def asset(seed=0, label="Car", count=6):
    meta = {"licence": "CC BY 4.0", "attribution": "PandaSet", "source": "drive 002", "views": 7, "pi": math.pi, "text": 'a "b" ü'}
    return Asset(gaussians(count, seed=seed), [4.1, 1.7999999999, 1.5], label, SplatModel(antialias=True), meta)


def scene(tracks=("veh_12", "12ab/ü", "veh 12", "Veh_12"), sky=True, ground=True):
    """A scene with awkward names, a shifted principal point, and times of a real clock."""
    dice = torch.Generator().manual_seed(7)
    path = trajectory(seed=3)
    rig = {
        "front camera": RigCamera(
            Pinhole(1970.0131979, 1970.5, 970.0002, 483.2988),
            1920,
            1080,
            poses(1, 4, 2.0)[0],
            torch.rand(3, 4, generator=dice),
            path.times_us + 7,
        ),
        "left": RigCamera(Pinhole(930.1, 931.2, 460.3, 260.4), 960, 540, torch.eye(4)),
    }
    return Scene(
        Placed(gaussians(40, 9), poses(1, 5, 1e5)[0]),
        tuple(Actor(asset(i, count=i + 3), trajectory(5 + i, seed=20 + i), track) for i, track in enumerate(tracks)),
        Sky(5 * torch.rand(16, 32, 3, generator=dice)) if sky else None,
        path,
        rig,
        SplatModel(projection="ewa", dilation=0.1),
        Ground(torch.randn(5, 7, generator=dice), (-3.1, 2.7), 0.3) if ground else None,
        {"name": "s1", "licence": "CC BY 4.0", "attribution": "Hesai and Scale AI", "nested": {"list": [1, 2.5, None]}},
    )
