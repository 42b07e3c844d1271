"""Frames of a camera that follows the light are told apart by what lidar says is one surface."""

import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from painted import drive as drive_without_lidar
from PIL import Image
from quick_fit import CONFIG, SIZE

from recon import open_log, reconstruct
from recon.begin import begin
from recon.log import LidarPoints, Log, Packed, Sweep
from recon.views import exposed as exposure
from recon.views.frames import load_frames
from recon.views.gains import gains_along
from recon.views.view import View
from render import render_frame
from render.compare import psnr
from scenes import load
from scenes.camera import Camera, RigCamera
from scenes.lenses import Pinhole
from scenes.report import validate
from scenes.trajectory import Trajectory

TRUE = np.exp(-0.13 * np.arange(8)) * [1, 1, 1.1, 1, 1, 0.9, 1, 1]
"""Gains of eight frames, from 1 to 0.4, not all of which fall evenly."""


def test_gains_come_back_though_some_is_clipped_and_some_moves():
    generator = np.random.default_rng(1)
    gains = np.exp(np.linspace(-0.7, 0.8, 30))[:, None] * [1.0, 0.95, 1.05]
    points = np.stack([generator.uniform(-6, 6, 4000), generator.uniform(-4, 4, 4000), np.full(4000, 10.0)], 1)
    colour = generator.uniform(0.15, 0.6, (96, 128, 3))  # of the wall at z = 10, a texel a pixel
    images, cameras = [], []
    for i, gain in enumerate(gains):
        image = np.clip(np.kron(colour, np.ones((3, 3, 1))) * gain, 0, 1)
        image[20 * (i % 10) : 20 * (i % 10) + 60, 100:200] = 0.5  # somebody passes
        images.append(torch.from_numpy((255 * image).round().astype(np.uint8)))
        cameras.append(Camera(Pinhole(300.0, 300.0, 192.0, 144.0), 384, 288, torch.eye(4, dtype=torch.float64)))
    found = gains_along(images, cameras, [points] * len(images))
    relative = found / found[0] / (gains / gains[0])
    assert np.abs(relative - 1).max() < 0.05 and np.log(found).mean() == pytest.approx(0, abs=1e-9)


def test_frames_that_share_nothing_are_not_told():
    picture = torch.full((48, 64, 3), 100, dtype=torch.uint8)
    away = Camera(Pinhole(50.0, 50.0, 32.0, 24.0), 64, 48, torch.eye(4, dtype=torch.float64))
    assert np.isnan(gains_along([picture, picture // 2], [away, away], [np.array([[0.0, 0, -5]])] * 2)).all()


def test_a_view_is_seen_as_if_its_camera_had_exposed_it_as_all_others():
    picture = torch.tensor([[[51, 102, 204], [0, 0, 255]]], dtype=torch.uint8)
    view = View(0, 0, 0, picture, False, torch.zeros(0), gain=torch.tensor([2.0, 1.0, 0.5]))
    assert view.evenly() == pytest.approx(np.array([[[0.1, 0.4, 1.6], [0, 0, 2]]]))
    assert view.evenly(np.array([0]), np.array([1])) == pytest.approx(np.array([[0, 0, 2]]))
    assert replace(view, gain=None).evenly() == pytest.approx(np.array([[[0.2, 0.4, 0.8], [0, 0, 1]]]))
    assert exposure._divided(view, torch.tensor([2.0, 1.0, 0.5])).image.tolist() == [[[26, 102, 255], [0, 0, 255]]]


def test_a_picture_is_compared_by_the_points_that_were_measured_nearest_to_its_moment(monkeypatch):
    """Of those within reach of its camera."""
    nothing = torch.zeros(0)
    views = [View(0, i, t, nothing, False, nothing) for i, t in enumerate((40_000, 160_000, 310_000))]

    def sweep(i: int) -> Sweep:
        xyz = np.array([[30.0, 0, i], [50.0, 0, i]])
        return Sweep(i, 100_000 * i, lambda: LidarPoints(xyz, np.zeros(2, np.int64), np.zeros(2, np.int64)))

    still = Trajectory(torch.tensor([0]), torch.eye(4, dtype=torch.float64)[None])
    log = Log("made", Path("made"), {}, tuple(map(sweep, range(4))), (), still, {})
    camera = Camera(Pinhole(50.0, 50.0, 32.0, 24.0), 64, 48, torch.eye(4, dtype=torch.float64))
    monkeypatch.setattr(exposure, "_gained", lambda log, names, views, points: [points(v, camera).tolist() for v in views])
    assert exposure.exposed(log, ["front"], views) == [[[30, 0, 0]], [[30, 0, 2]], [[30, 0, 3]]]


@pytest.fixture
def following(own_drive):
    """The made-up drive, its pictures exposed one by one."""
    for folder in (own_drive / "camera").iterdir():
        for i, gain in enumerate(TRUE):
            file = folder / f"{i:02d}.jpg"
            image = np.asarray(Image.open(file)).astype(float) * gain
            Image.fromarray(image.clip(0, 255).round().astype(np.uint8)).save(file, quality=95)
    return own_drive


def test_views_say_how_they_were_exposed_and_held_out_ones_what_is_likely(following, drive, capsys):
    log = open_log(following)
    names, span = ["front_camera"], (0, int(1e18))
    frames = load_frames(log, names, span, SIZE, 4)
    assert "exposure varies" in capsys.readouterr().err
    found = torch.stack([v.gain for v in frames.views]).mean(1).numpy()
    shown = [i for i, v in enumerate(frames.views) if not v.held_out]
    wanted = TRUE / np.exp(np.log(TRUE[shown]).mean())
    assert np.abs(found[shown] / wanted[shown] - 1).max() < 0.04
    assert found[4] == pytest.approx(np.sqrt(found[3] * found[5]), rel=0.02), "not looked at, between its neighbours"
    assert all(v.gain is None for v in load_frames(open_log(drive), names, span, SIZE, 4).views), "nothing to do, nothing done"


def test_a_drive_without_lidar_tells_its_gains_by_the_points_that_its_pictures_show(capsys):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
    log = drive_without_lidar([0.0] + [0.6] * 7)

    def taken(file: Packed, gain: np.ndarray) -> Packed:
        buffer = BytesIO()
        image = np.asarray(Image.open(BytesIO(file.read()))) * gain
        Image.fromarray(image.clip(0, 255).round().astype(np.uint8)).save(buffer, "png")
        return Packed(file.name, buffer.getvalue)

    front = log.camera("front")
    following = replace(front, files=tuple(taken(f, g) for f, g in zip(front.files, TRUE, strict=True)))
    log, names, size = replace(log, cameras={**log.cameras, "front": following}), ["front", "left"], (320, 180)
    start, fit = begin(log, names, (0, 10**9), size, replace(CONFIG, budget=3000), held_out=0)
    assert "front: its exposure varies" in capsys.readouterr().err
    found = torch.stack([v.gain for v in fit.frames.views if v.camera == 0]).numpy()
    wanted = TRUE[:, None] / np.exp(np.log(TRUE).mean())
    assert np.abs(found / wanted - 1).max() < 0.06
    assert all(v.gain is None for v in fit.frames.views if v.camera == 1), "nothing to do, nothing done"
    _, again = begin(log, names, (0, 10**9), size, replace(CONFIG, budget=3000), held_out=0, start=start)
    assert all(a.gain is b.gain for a, b in zip(fit.frames.views, again.frames.views, strict=True)), "they are not looked for again"


def test_a_scene_shows_each_frame_as_it_was_exposed(following, tmp_path):
    made = reconstruct(open_log(following), tmp_path / "s", size=SIZE, held_out=4, config=CONFIG)
    scene, log = load(tmp_path / "s"), open_log(following)
    rig = scene.rig_camera("front_camera")
    assert torch.equal(rig.gains, made.rig["front_camera"].gains) and rig.gains.shape == (8, 3)
    assert made.meta["held_out"][0]["psnr"] > 25
    t = scene.frame_times("front_camera").tolist()
    shown, photo = [], []
    for i in (2, 6):
        camera = scene.camera("front_camera", t[i])
        shown.append(render_frame(scene, camera).rgb)
        photo.append(torch.from_numpy(np.array(log.camera("front_camera").image(i, *SIZE))) / 255)
    assert all(psnr(a, b) > 25 for a, b in zip(shown, photo, strict=True))
    assert psnr(shown[0] * float(TRUE[6] / TRUE[2]), photo[1]) < psnr(shown[1], photo[1])


def test_exposures_between_frames_and_beyond_them():
    gains = torch.tensor([[1.0, 1, 1], [4.0, 4, 1]])
    rig = RigCamera(Pinhole(50.0, 50.0, 32.0, 24.0), 64, 48, torch.eye(4), times_us=torch.tensor([0, 100]), gains=gains)
    assert rig.exposure_at(50).diagonal().tolist() == pytest.approx([2, 2, 1])
    assert rig.exposure_at(-10).diagonal().tolist() == [1, 1, 1] and rig.exposure_at(500).diagonal().tolist() == pytest.approx([4, 4, 1])
    assert torch.equal(rig.at(torch.eye(4, dtype=torch.float64), 100).exposure, rig.exposure_at(100))
    with pytest.raises(ValueError, match="gains must have shape"):
        RigCamera(rig.lens, 64, 48, torch.eye(4), times_us=torch.tensor([0]), gains=gains)


def test_what_drives_along_is_lit_as_the_exposure_follows(street):
    """Recorded, it looks in all frames as it did; put in, it is exposed as the street is."""
    track = street.actors[0]
    times = street.frame_times("front_camera")
    rig = {name: replace(c, gains=torch.linspace(1, 2, len(c.times_us))[:, None].expand(-1, 3)) for name, c in street.rig.items()}
    following = replace(street, rig=rig)
    asset = replace(track.asset, meta={**track.asset.meta, "id": "car/0001", "inserted": True})
    put_in = replace(following, actors=(replace(track, asset=asset),))
    looked = 0
    for t in times.tolist():
        gain = float(rig["front_camera"].exposure_at(t)[0, 0])
        shown = [render_frame(s, s.camera("front_camera", t), ("rgb", "instance")) for s in (street, following, put_in)]
        inner = torch.nn.functional.max_pool2d((shown[0].instance != 1).float()[None, None], 3, 1, 1)[0, 0] == 0
        if not inner.any():
            continue
        looked += 1
        plain, same, exposed = (f.rgb[inner].mean() for f in shown)
        assert float(same) == pytest.approx(float(plain), rel=0.02) and float(exposed) == pytest.approx(gain * float(plain), rel=0.02)
        road = shown[0].instance == 0
        assert float((shown[1].rgb[road] / shown[0].rgb[road].clamp_min(0.01)).median()) == pytest.approx(gain, rel=0.01)
    assert looked > 2


def test_a_gain_that_is_no_positive_number_is_reported(following, tmp_path):
    reconstruct(open_log(following), tmp_path / "s", size=SIZE, held_out=4, config=replace(CONFIG, steps=2))
    assert validate(tmp_path / "s") == []
    file = tmp_path / "s" / "metadata.json"
    table = json.loads(file.read_text())
    table["cameras"]["front_camera"]["gains"][2][1] = 0.0
    file.write_text(json.dumps(table))
    assert any("gain is not a positive number" in p for p in validate(tmp_path / "s"))
