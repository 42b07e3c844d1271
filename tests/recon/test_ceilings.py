"""A ceiling is no sky: it moves as what is near does."""

from pathlib import Path

import numpy as np
import pytest
import torch

from recon.log import Log, LogCamera
from recon.views.ceilings import ROOM, without_ceilings
from recon.views.view import View
from render.rays import world_directions
from scenes.lenses import Pinhole
from scenes.trajectory import Trajectory

SIZE = 96, 72
CEILING = 1.9
"""Metres above the camera."""


def robot(roofed: bool, metric: bool = True) -> tuple[Log, list[View]]:
    """A camera that goes ahead by 12 cm a picture under spots, of a ceiling or of clouds; all above the horizon is said to be sky."""
    times = 100_000 * torch.arange(16)
    body = torch.eye(4, dtype=torch.float64).repeat(16, 1, 1)
    body[:, 0, 3] = 0.12 * torch.arange(16)
    mount = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]], dtype=torch.float64)
    camera = LogCamera("front", Pinhole(60.0, 60.0, 48.0, 36.0), *SIZE, (), times, body @ mount)
    log = Log("room", Path("room"), {"front": camera}, (), (), Trajectory(times, body), {"metric": metric}, ("front",))
    views = []
    for i in range(16):
        ways = world_directions(camera.camera(i)).numpy()
        above = ways[..., 2] > 0.08
        x, y = np.moveaxis(ways[..., :2] / np.maximum(ways[..., 2:], 0.08) * CEILING, -1, 0)
        spots = np.sin(3.0 * (x + (0.12 * i if roofed else 0.0))) * np.sin(4.0 * y)
        image = np.where(above, 205 + 35 * spots, 90).astype(np.uint8)
        views.append(View(0, i, int(times[i]), torch.from_numpy(np.repeat(image[..., None], 3, 2)), False, torch.from_numpy(above)))
    return log, views


def skies(*args, far: float = 6.0) -> float:
    log, views = robot(*args)
    return float(torch.stack([v.sky.float() for v in without_ceilings(log, ["front"], views, far)]).mean())


def test_a_ceiling_is_no_sky_and_clouds_are(capsys):
    assert skies(True) == 0 and "moves as a ceiling does" in capsys.readouterr().err
    assert skies(False) > 0.3 and not capsys.readouterr().err


@pytest.mark.parametrize("more", [{"far": ROOM + 1}, {"far": np.inf}])
def test_along_a_street_nobody_looks_for_ceilings(more):
    assert skies(True, **more) == skies(False)


def test_nor_where_metres_are_not_known():
    assert skies(True, False) == skies(False)
