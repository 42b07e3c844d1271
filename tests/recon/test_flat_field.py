"""What a lens darkens is found by what renders are off by, shown as its camera shows it, and told apart from the street."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from quick_fit import CONFIG, SIZE

import render.flat_field
from recon import open_log, reconstruct
from recon.begin import begin
from recon.evaluation.road import photo_at, road_errors, road_points
from recon.fit.fit import Fit
from recon.fit.flat_field import FlatField
from recon.views.frames import load_frames
from render import render_frame
from render.flat_field import evened, in_flat_field
from scenes import load
from scenes.report import validate

HOST = torch.device("cpu")


def darker_towards_corners(height: int, width: int) -> torch.Tensor:
    """`[height, width, 1]`: 1 in the middle, 0.7 in the corners."""
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n + 1)[1:] - 1 / n for n in (height, width)), indexing="ij")
    return (1 - 0.15 * (x**2 + y**2))[..., None]


def test_what_a_lens_darkens_is_found_by_what_renders_are_off_by():
    generator = torch.Generator().manual_seed(3)
    field, true = FlatField.even(320, 180, HOST), darker_towards_corners(180, 320)
    assert field.found() is None and field.gains.shape == (9, 16, 3)
    for _ in range(12):
        for _ in range(6):
            street = 0.2 + 0.6 * torch.rand(180, 320, 3, generator=generator)
            field.compare(field.over(street), (street * true).clone())
        field.follow()
    wanted = darker_towards_corners(9, 16)
    off = field.found() / wanted
    assert (off / off.mean()).log().abs().max() < 0.02, "blurred at the corners"
    assert field.gains.log().mean((0, 1)).abs().max() < 1e-5, "how bright all is, is the exposure's"


def test_what_is_clipped_or_not_alike_says_nothing():
    field, street = FlatField.even(320, 180, HOST), torch.full((180, 320, 3), 0.5)
    photo = street.clone()
    photo[:90] = 1.0  # clipped
    photo[90:, :160] = 0.3  # a car that is not rendered
    field.compare(street, photo)
    field.follow()
    assert field.found() is None


def test_a_night_that_is_rendered_darker_than_black_leaves_a_field_of_numbers():
    """As an exposure with an offset renders it."""
    field = FlatField.even(320, 180, HOST)
    for _ in range(20):
        field.compare(torch.full((180, 320, 3), -0.03), torch.full((180, 320, 3), 0.01))
    field.follow()
    assert field.gains.isfinite().all() and field.found() is None, "alike everywhere"


def test_a_picture_that_is_not_alike_and_no_number_is_left_out():
    field = FlatField.even(320, 180, HOST)
    render = torch.full((180, 320, 3), 0.5)
    render[0, 0] = torch.nan
    field.compare(render, torch.full((180, 320, 3), 0.5))
    assert field.sums.isfinite().all()


def test_of_a_field_the_grid_goes_to_a_device_and_not_the_picture(monkeypatch):
    sent = []
    monkeypatch.setattr(render.flat_field, "upload", lambda t, device: sent.append(t.numel()) or t)
    field = darker_towards_corners(9, 16).expand(9, 16, 3).contiguous()
    for _ in range(3):
        in_flat_field(torch.ones(180, 320, 3), field)
    assert sent == [field.numel()]


def test_few_pictures_of_a_camera_tell_nothing_of_its_lens():
    """Of two cameras the first has four pictures to be fitted to, the other five."""
    frames, fields = SimpleNamespace(of=lambda c: range(4 + c)), [FlatField.even(96, 54, HOST)] * 2
    assert Fit._evened(SimpleNamespace(frames=frames, flat_fields=fields, config=CONFIG)) == [1]


def test_corners_that_are_black_do_not_brighten_the_rest():
    field, street = FlatField.even(320, 180, HOST), torch.full((180, 320, 3), 0.08)
    for _ in range(60):
        photo = street.clone()
        photo[:60, :100] = 0.0
        for _ in range(6):
            field.compare(field.over(street), photo)
        field.follow()
    assert field.gains.min() >= 1 / 4 and field.gains.max() < 2


@pytest.fixture(scope="module")
def darkened(drive, tmp_path_factory):
    """The made-up drive through a lens that darkens corners."""
    import shutil

    folder = shutil.copytree(drive, tmp_path_factory.mktemp("darkened") / "drive")
    for file in folder.glob("camera/*/*.jpg"):
        image = np.asarray(Image.open(file)).astype(float)
        image *= darker_towards_corners(*image.shape[:2]).numpy()
        Image.fromarray(image.round().astype(np.uint8)).save(file, quality=95)
    return folder


@pytest.fixture(scope="module")
def made(darkened, tmp_path_factory):
    """Its scene on disk, and the one of a fit that takes lenses to be even."""
    both = []
    with pytest.MonkeyPatch.context() as patch:
        # photos as small as these tell less of depth than lidar does: comparing them costs as much as the field gains
        patch.setattr("recon.fit.agreement.WEIGHT", 0.0)
        for name, config in (("s", CONFIG), ("even", CONFIG.without("flat fields"))):
            path = tmp_path_factory.mktemp("scenes") / name
            reconstruct(open_log(darkened), path, size=SIZE, held_out=4, config=config)
            both.append(path)
    return both


def test_a_drive_through_a_lens_that_darkens_corners_is_told_from_a_dark_street(made):
    scene, even = map(load, made)
    field = scene.rig["front_camera"].flat_field
    assert even.rig["front_camera"].flat_field is None
    off = field.mean(-1) / darker_towards_corners(*field.shape[:2])[..., 0]
    below = off[off.shape[0] // 2 :]  # above is the sky, whose level no splat holds
    assert (below / below.mean()).log().abs().mean() < 0.06
    found, plain = (s.meta["held_out"][0]["psnr"] for s in (scene, even))
    assert found > plain + 0.5
    camera = scene.camera("front_camera", int(scene.frame_times("front_camera")[3]))
    shown, bare = (render_frame(scene, c).rgb for c in (camera, replace(camera, flat_field=None)))
    assert torch.allclose(shown, in_flat_field(bare, field)) and not torch.allclose(shown, bare)
    assert torch.allclose(evened(shown, field), bare, atol=1e-6)


def test_pictures_of_other_sizes_are_darkened_alike(made):
    camera = load(made[0]).rig["front_camera"]
    large, small = (in_flat_field(torch.ones(9 * n, 16 * n, 3), camera.flat_field) for n in (12, 4))
    assert torch.allclose(large.unflatten(0, (36, 3)).unflatten(2, (64, 3)).mean((1, 3)), small, atol=0.01)


def test_a_field_that_is_known_is_kept(darkened, made):
    rig, names = load(made[0]).rig, ["front_camera"]
    known = CONFIG.without("exposures", "gains", "flat fields")
    _, fit = begin(open_log(darkened), names, (0, int(1e18)), SIZE, replace(known, steps=10), held_out=0, exposed=rig)
    for _ in range(10):
        fit.step()
    assert torch.equal(fit.flat_fields[0].found(), rig["front_camera"].flat_field)


def test_a_gain_of_a_field_that_is_no_positive_number_is_reported(made):
    assert validate(made[0]) == []
    file = made[0] / "metadata.json"
    whole = file.read_text()
    table = json.loads(whole)
    table["cameras"]["front_camera"]["flat_field"][2][1][0] = -1.0
    file.write_text(json.dumps(table))
    try:
        assert any("flat field of camera front_camera" in p for p in validate(made[0]))
    finally:
        file.write_text(whole)


def test_the_road_is_compared_as_if_all_of_a_picture_were_alike(street, drive):
    """A shifted camera shows the road elsewhere in its picture than the photo does."""
    log = open_log(drive)
    frames = load_frames(log, ["front_camera"], (0, int(1e18)), SIZE, 4)
    time = log.sweeps_within((0, int(1e18)))[2].time_us
    view, points = photo_at(frames, "front_camera", time), road_points(log.sweeps_within((0, int(1e18)))[2].read().xyz, street.ground)
    grey, recorded = torch.full(view.image.shape, 0.5), street.camera("front_camera", time)
    pose = recorded.world_from_cam.clone()
    pose[1, 3] += 1.0
    field = darker_towards_corners(9, 16).expand(9, 16, 3)
    aside = replace(recorded, world_from_cam=pose, flat_field=field)
    photo = replace(view, image=(255 * in_flat_field(grey, field)).round().to(torch.uint8))
    errors = road_errors(in_flat_field(grey, field), aside, photo, recorded, points)
    assert len(errors) > 10 and errors.max() < 1e-4
