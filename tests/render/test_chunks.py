"""Pictures with more entries than memory should hold are drawn in windows: the same bits, the same gradients, less memory."""

from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from render.chunks import window, windows
from render.kernels.types import RECORD, S_MAX, Y_EXT, H, K, X, Y
from scenes import Camera, Pinhole
from tests.render.test_rasterize import two_instances

CAMERA = Camera(Pinhole(120.0, 122.0, 65.0, 40.0), 139, 75, torch.eye(4, dtype=torch.float64))
OUTPUTS = ("rgb", "alpha", "depth", "instance")


def frame_and_gradients(most_entries: int):
    placed = [replace(p, gaussians=p.gaussians.map(lambda t: t.clone().requires_grad_())) for p in two_instances(1)]
    frame = rasterize(placed, CAMERA, OUTPUTS, config=RenderConfig(most_entries=most_entries))
    (frame.rgb.square().sum() + frame.alpha.sum() + frame.depth[frame.depth.isfinite()].sum()).backward()
    return frame, [t.grad for p in placed for t in p.gaussians.tensors().values()]


@pytest.mark.parametrize("most", [1, 300, 1000])
def test_windows_change_no_pixel_and_no_gradient(most):
    whole, expected = frame_and_gradients(1 << 25)
    parts, grads = frame_and_gradients(most)
    for name in OUTPUTS:
        assert torch.equal(getattr(whole, name), getattr(parts, name)), name
    for mine, reference in zip(grads, expected, strict=True):  # sums of the same numbers in another order
        assert (mine - reference).abs().max() <= 1e-5 * reference.abs().max()


def walls(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Records of splats that cover a 16384x16384 image, and their room in it: a million tiles each."""
    records = torch.zeros(count, RECORD)
    for field, value in {X: 8192.0, Y: 8192.0, H: 1e-12, K: 1e-6, S_MAX: 1.0, Y_EXT: 1e6}.items():
        records[:, int(field)] = value
    return records, torch.full((count,), 1024 * 1024, dtype=torch.int32)


def test_more_than_2_to_the_31_entries_are_counted_and_divided():
    records, counts = walls(5000)
    assert int(counts.sum(dtype=torch.int64)) > 2**32
    parts = windows(records, counts, window(0, 0, 1024, 1024), 1 << 25)
    covered = torch.zeros(1024, 1024, dtype=torch.int32)
    for w in parts:
        assert w.tiles_x * w.tiles_y * 5000 <= 1 << 25
        covered[w.top : w.top + w.tiles_y, w.left : w.left + w.tiles_x] += 1
    assert (covered == 1).all()


def test_what_fits_is_not_divided():
    records, counts = walls(3)
    (only,) = windows(records, counts, window(0, 0, 1024, 1024), 1 << 25)
    whole = window(0, 0, 1024, 1024)
    assert (only.left, only.top, only.tiles_x, only.tiles_y) == (whole.left, whole.top, whole.tiles_x, whole.tiles_y)
