"""What a reconstruction takes where nobody says otherwise."""

from dataclasses import replace

import pytest
from made_colmap import pictures_along, write_colmap

from recon import open_log
from recon.defaults import FEW, MOST, PER_PHOTO, _span, fit_config, fit_size
from recon.fit.config import FitConfig

NEEDS = "needs pycolmap: pip install 'sidestep[colmap]'"


def test_photos_that_stand_apart_are_not_learnt_by_heart(street, drive, tmp_path):
    pytest.importorskip("pycolmap", reason=NEEDS)
    log = open_log(write_colmap(tmp_path / "far", street, {"": pictures_along(street, count=6, step=4.0)}))
    config = fit_config(log, ["camera"])
    assert (config.steps, config.budget) == tuple(base + 6 * n for base, n in zip(FEW, PER_PHOTO, strict=True))
    assert config.steps < FitConfig().steps
    drive_config = fit_config(open_log(drive), ["front_camera"])
    assert drive_config.steps > config.steps and drive_config.sh_degree > 0 and drive_config.drop == 0 < config.drop
    assert fit_size(log, ["camera"]) == (96, 54)  # never larger than the pictures are


def test_pictures_as_near_as_a_videos_are_fitted_as_a_drives(workspace, drive):
    pytest.importorskip("pycolmap", reason=NEEDS)
    near = fit_config(open_log(workspace), ["camera"])
    assert near.drop == 0 and near.steps > fit_config(open_log(drive), ["front_camera"]).steps  # of eight pictures, and these are twelve


def test_a_fit_is_longer_and_finer_the_more_pictures_it_has(drive):
    log = open_log(drive)
    one, (first, last) = fit_config(log, ["front_camera"]), (int(t) for t in log.camera("front_camera").times_us[[0, -1]])
    both, half = fit_config(log, ["front_camera", "front_camera"]), fit_config(log, ["front_camera"], (first, (first + last) // 2))
    assert half.steps < one.steps < both.steps <= MOST[0] and half.budget < one.budget < both.budget <= MOST[1]


def test_effort_multiplies_steps_and_splats_of_drives_and_photos_also_beyond_what_they_get_at_most(drive, tmp_path, street):
    log = open_log(drive)
    many = ["front_camera"] * 100
    pytest.importorskip("pycolmap", reason=NEEDS)
    photos = open_log(write_colmap(tmp_path / "far", street, {"": pictures_along(street, count=6, step=4.0)}))
    for of, names in ((log, ["front_camera"]), (log, many), (photos, ["camera"])):
        usual = fit_config(of, names)
        for effort in (0.1, 3):
            asked = fit_config(of, names, effort=effort)
            assert (asked.steps, asked.budget) == (round(effort * usual.steps), round(effort * usual.budget))
            assert asked == replace(usual, steps=asked.steps, budget=asked.budget)
    assert fit_config(log, many).steps == MOST[0] < fit_config(log, many, effort=3).steps


def test_a_span_keeps_the_frames_of_all_cameras_together(drive):
    log = open_log(drive)
    names = list(log.cameras)
    for start, duration, expected in ((0, None, 8), (0, 300_000, 3), (200_000, 300_000, 3), (500_000, None, 3)):
        first, last = _span(log, names, start, duration)
        for name in names:
            assert sum(first <= t <= last for t in log.cameras[name].times_us.tolist()) == expected
    with pytest.raises(ValueError, match="lasts 0.7s"):
        _span(log, names, 5_000_000, None)
    with pytest.raises(ValueError, match="must be positive"):
        _span(log, names, 0, -1)
