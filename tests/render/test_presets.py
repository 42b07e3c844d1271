"""The presets that benchmarks share: they draw, and the budget holds on them at low size."""

import pytest
import torch

from render import rasterize
from tests.bench.limit import rows_of
from tests.bench.plot import Chart, save
from tests.bench.presets import Missing, presets, street

SMALL = [n for n in presets() if not n.endswith("M") and n not in ("uniform-500k", "drive-1920x1080")]


@pytest.mark.parametrize("name", SMALL)
def test_every_preset_draws_something(name):
    try:
        preset = presets()[name]()
    except Missing as missing:
        pytest.skip(str(missing))
    camera = preset.camera.resized(96, 54)
    frame = rasterize(preset.placed, camera, ("rgb", "alpha"), model=preset.model)
    assert frame.rgb.isfinite().all() and frame.alpha.mean() > 0.05 and len(preset) > 10_000


def test_a_street_has_as_many_splats_as_asked_and_mostly_out_of_view():
    preset = street(150_000)
    assert len(preset) == 150_000
    assert rasterize(preset.placed, preset.camera.resized(64, 36), ("alpha",), model=preset.model).alpha.mean() > 0.2


def test_a_chart_is_drawn_with_one_point_or_none(tmp_path):
    save([Chart("none", "x", "y"), Chart("one", "x", "y", {"a": [(1.0, 2.0)], "zero": [(1.0, 0.0)]})], tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000


def test_rows_of_a_circle_are_counted():
    from render.kernels.types import RECORD, S_MAX, Y_EXT, H, K, X, Y

    record = torch.zeros(1, RECORD, dtype=torch.float64)
    for field, value in {X: 8.0, Y: 8.0, K: 1.0, H: 1.0, S_MAX: 9.0, Y_EXT: 3.0}.items():  # of radius 3 pixels
        record[0, int(field)] = value
    assert rows_of(record, torch.tensor([0]), 1).tolist() == [6.0]
