"""`RenderConfig(max_error=e)`: no pixel is further than e from truth, on random scenes of every kind and on the presets."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from recon import open_log, reconstruct
from recon.fit.config import FitConfig
from render import RenderConfig, rasterize
from render.budget import split
from render.canonical import canonical_frames
from render.cull import in_sight
from render.kernels.types import Wanted
from render.rays import exact_rays
from render.settings import Settings
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import matrix_from_quat, translation
from tests import oracle
from tests.bench.culling import those_in_sight
from tests.bench.presets import Missing, Preset, drive, presets, random_splats, uniform
from tests.render.test_cuda import keep_forward
from tests.render.test_lenses import LENSES, around, camera_of
from tests.render.test_shutter import FISHEYE, PINHOLE, driven, traffic

BUDGETS = (1 / 64, 1 / 255, 1 / 1024, 1 / 4096)
CAMERA = Camera(Pinhole(40.0, 41.0, 20.0, 15.0), 40, 30, torch.eye(4, dtype=torch.float64))
SCENES = 200
PARTS = 10


def random_scene(seed: int) -> tuple[list[Placed], SplatModel]:
    """3 to 500 splats from dots to walls, from fog to paint, near and far, of both projections, with and without antialiasing."""
    dice = torch.Generator().manual_seed(seed)
    count, size, contrast, opacity, distance = torch.rand(5, generator=dice).tolist()
    g = random_splats(round(10 ** (0.5 + 2.2 * count)), seed, sh_count=(1, 4, 9, 16)[seed % 4])
    logits = g.logit_opacities * (0.5 + 2 * contrast) + 8 * opacity - 5
    g = replace(g, log_scales=g.log_scales + 3 * size - 1.5, logit_opacities=logits)
    model = SplatModel(projection=("ut", "ewa")[seed % 2], antialias=seed % 3 == 0)
    return [Placed(g, translation(0, 0, 1 + 6 * distance))], model


def fog(seed: int) -> tuple[list[Placed], SplatModel]:
    """Thousands of splats, each of which is below the cutoff of a loose budget, together opaque."""
    g = random_splats(3000, seed, sh_count=1)
    return [Placed(replace(g, logit_opacities=torch.full((3000,), -4.0 - seed)), translation(0, 0, 5))], SplatModel()


def brightest(placed: list[Placed], camera: Camera) -> float:
    """The unit of a budget: the brightest colour that a splat shows the camera, 1 at least."""
    return max(1.0, *(float(oracle.colours(p, camera).max()) for p in placed if len(p.gaussians)))


def assert_kept(placed, camera, model, where: str) -> None:
    with torch.no_grad():
        end, ends = camera.world_from_cam_end, [p.world_from_local_end for p in placed]
        rgb, *_ = oracle.render(oracle.as_oracle(placed), camera, model, order="pixel", world_from_cam_end=end, ends=ends)
    unit = brightest(placed, camera)
    for e in BUDGETS:
        drawn = rasterize(placed, camera, ("rgb",), model=model, config=RenderConfig(max_error=e)).rgb
        off = (drawn.double() - rgb).abs().max()
        assert off <= e * unit, f"{where}: {float(off / unit):.2e} from truth with a budget of {e:.2e}"


@pytest.mark.parametrize("part", range(PARTS))
def test_random_scenes_keep_every_budget(part):
    for seed in range(part * SCENES // PARTS, (part + 1) * SCENES // PARTS):
        placed, model = random_scene(seed)
        assert_kept(placed, CAMERA, model, f"scene {seed}")


@pytest.mark.parametrize("seed", range(3))
def test_a_fog_of_splats_below_the_cutoff_keeps_every_budget(seed):
    placed, model = fog(seed)
    assert_kept(placed, CAMERA, model, f"fog {seed}")


@pytest.mark.parametrize("response", ["conic", "ray"])
def test_a_stack_keeps_every_budget(response):
    """Hundreds of splats in one line of sight, all of whose tails fall on the same pixels: each may leave out its part of the budget."""
    n = 400
    means = torch.stack([torch.zeros(n), torch.zeros(n), torch.linspace(5, 5.5, n)], 1)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    g = Gaussians(means, quats, torch.full((n, 3), -1.6), torch.zeros(n), torch.ones(n, 1, 3))
    assert_kept([Placed(g, torch.eye(4, dtype=torch.float64))], CAMERA, SplatModel(response=response), "stack")


def test_the_uniform_preset_keeps_every_budget():
    """As dense as uniform-100k, on 96x64."""
    g, camera, model = uniform(1176, 96, 64)
    assert_kept([Placed(g, torch.eye(4, dtype=torch.float64))], camera, model, "uniform")


def test_the_drive_keeps_every_budget():
    """A sixth of its splats on an image so small that dozens share a pixel: their tails come together where walls end."""
    preset = drive(32, 18)
    thinned = [replace(p, gaussians=p.gaussians.select(torch.arange(0, len(p.gaussians), 6))) for p in preset.placed]
    assert_kept(thinned, preset.camera, preset.model, "drive")


@pytest.fixture(scope="session")
def lund(shared, tmp_path_factory) -> Path:
    """A scene of the photos of lund: the folder that SIDESTEP_LUND names, else one that is fitted for a few seconds."""
    if "SIDESTEP_LUND" in os.environ:
        return Path(os.environ["SIDESTEP_LUND"])
    folder = tmp_path_factory.mktemp("lund") / "scene"
    reconstruct(open_log(shared / "lund", camera_height=1.6), folder, size=(480, 270), config=FitConfig(steps=40))
    return folder


def test_lund_keeps_every_budget(lund):
    assert_small_cameras_keep_every_budget("lund", presets(lund_folder=lund)["lund"]())


@pytest.mark.parametrize("name", ["drive-480x270", "drive-960x540", "drive-1920x1080", "biker", "street-1M", "street-3M"])
def test_every_preset_keeps_every_budget(name):
    try:
        preset = presets()[name]()
    except Missing as missing:
        pytest.skip(str(missing))
    assert_small_cameras_keep_every_budget(name, preset)


def assert_small_cameras_keep_every_budget(name: str, preset: Preset) -> None:
    """Three small cameras that look at what the preset's shows at full size: near its bottom, at the horizon, and to one side."""
    whole = preset.camera
    for x, y in [(0.5, 0.8), (0.45, 0.5), (0.8, 0.45)]:
        left, top = int(x * whole.width), int(y * whole.height)
        lens = replace(whole.lens, cx=float(whole.lens.cx) - left, cy=float(whole.lens.cy) - top)
        camera = replace(whole, lens=lens, width=20, height=12)
        seen = in_sight(preset.placed, camera, preset.model)
        nearby = [p for p in those_in_sight(preset.placed, seen) if len(p.gaussians)]
        assert_kept(nearby, camera, preset.model, f"{name} at {left}, {top}")


@pytest.mark.parametrize("name", LENSES)
def test_every_lens_keeps_every_budget(name):
    for seed in (1, 2):
        assert_kept(around(seed), camera_of(LENSES[name]), SplatModel(antialias=seed == 2), f"{name} {seed}")


@pytest.mark.parametrize(("lens", "shutter"), [(PINHOLE, "rows"), (FISHEYE, "columns")], ids=["pinhole-rows", "fisheye-columns"])
def test_moving_shutters_keep_every_budget(lens, shutter):
    for seed in (0, 1):
        assert_kept(traffic(seed), driven(lens, shutter), SplatModel(), f"traffic {seed}")


def test_where_no_splats_can_change_places_the_tiles_draw():
    """Flat splats that face the camera at rising depth: all tiles are settled, and the picture is the same bits as in their order."""
    g, camera, model = uniform(1176, 96, 64)
    limits = split(1 / 255)
    by_pixel, by_tile = (rasterize(g, camera, model=model, config=RenderConfig(**limits | {"order": o})).rgb for o in ("pixel", "tile"))
    assert torch.equal(by_pixel, by_tile)


def test_tiles_are_settled_only_where_the_tiles_order_is_every_pixels():
    """Of clouds from sparse to dense: the proof may miss a tile, and never claims one in which the oracle's order is another."""
    claimed = missed = 0
    for seed, (count, size) in enumerate([(6, -1.5), (12, -1.0), (25, -0.5), (60, 0.0)]):
        g = random_splats(count, seed, sh_count=1)
        g = replace(g, log_scales=g.log_scales + size)
        pose = translation(0, 0, 5)
        with torch.no_grad():
            frames, (rays, _) = canonical_frames(g, pose), exact_rays(CAMERA, [], False)
        settings = Settings(40, 30, SplatModel(), RenderConfig(order="pixel"), Wanted(), (0,))
        kept, _ = keep_forward(settings, g, pose, CAMERA.lens, None, frames, rays)
        lists, settled = kept.parts[0].lists, kept.parts[0].ends[0]
        points = g.means.double() + pose[:3, 3]
        axes = matrix_from_quat(g.quats.double()) * g.log_scales.double().exp()[:, None, :]
        for tile in range(len(settled)):
            ids = lists.ids[lists.starts[tile] : lists.starts[tile + 1]].long()
            row, column = 16 * (tile // settings.tiles_x), 16 * (tile % settings.tiles_x)
            seen = rays[0, :, row : row + 16, column : column + 16].flatten(1).T
            keys = oracle.ray_depths(points[None, ids], axes[None, ids], seen, torch.zeros_like(seen))
            ordered = bool((keys.diff(dim=1) >= 0).all())
            assert ordered or not settled[tile], f"scene {seed}, tile {tile}"
            claimed += int(settled[tile])
            missed += int(ordered and not settled[tile])
    assert claimed > 5 and missed < 20, f"{claimed} claimed, {missed} missed"


@pytest.mark.parametrize("e", [0.0, -1.0, 1.0, 1e-5, float("nan")])
def test_a_budget_that_no_picture_can_keep_is_refused(e):
    with pytest.raises(ValueError, match="max_error must be at least"):
        RenderConfig(max_error=e)


def test_a_looser_budget_draws_less():
    """Entries of the tiles' lists, which is what time goes with: fewer for every step from strict to loose."""
    g, camera, model = uniform(3000, 192, 128)
    entries = []
    for e in BUDGETS:
        settings = Settings(192, 128, model, RenderConfig(**split(e) | {"order": "tile"}), Wanted(), (0,))
        kept, _ = keep_forward(settings, g, torch.eye(4, dtype=torch.float64), camera.lens)
        entries.append(int(kept.parts[0].lists.starts[-1]))
    assert entries == sorted(set(entries)), entries
