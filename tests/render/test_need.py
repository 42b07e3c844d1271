"""Need: nothing where a photo stood, more the further from it, everything where something was put; and of scenes by lot, as defined."""

import math
import random
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize, render_clip, render_frame
from render.need import ASIDE, COARSE, FACING, STRETCHED, far_from_photos, support_fields
from scenes import Actor, Asset, Camera, Equirectangular, Gaussians, Pinhole, Placed, RigCamera, Scene, Trajectory
from scenes.poses import inverse, pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats
from tests.render.test_lenses import HEIGHT, LENSES, WIDTH
from tests.render.test_rasterize import largest
from tests.render.test_shutter import PINHOLE

NEVER = torch.eye(4, dtype=torch.float64)


def camera_of(street, metres=0.0):
    ego = street.ego.shifted(lateral=metres)
    return street.camera("front_camera", int(street.frame_times("front_camera")[4]), ego)


def test_need_grows_with_the_distance_from_the_photos(street):
    needs = [render_frame(street, camera_of(street, metres), ("need",)) for metres in (0.0, 1.0, 3.0)]
    assert all(f.rgb is None and f.alpha is None and f.features is None for f in needs)
    means = [float(f.need.mean()) for f in needs]
    assert means[0] < means[1] < means[2]
    assert all(((f.need >= 0) & (f.need <= 1)).all() for f in needs)


def test_a_surface_is_far_from_the_photos_where_they_saw_it_from_the_side(street):
    camera = camera_of(street, 2.0)
    near, far = (far_from_photos(street, camera, torch.full((54, 96), depth)) for depth in (4.0, 60.0))
    assert near[:, 30:66].min() > 0.9 and far.max() == 0
    assert far_from_photos(street, camera, torch.full((54, 96), torch.inf)).max() == 0
    assert far_from_photos(street, camera_of(street), torch.full((54, 96), 4.0)).max() == 0


def test_a_photo_from_nearer_shows_a_surface_from_elsewhere_and_one_from_farther_does_not(street):
    """From a metre aside, of what is 10 metres ahead: a photo from 8 metres nearer sees it 27 degrees elsewhere, from farther 3."""
    times, needs = street.frame_times("front_camera"), []
    for time, forward in ((times[0], -8.0), (times[-1], 8.0)):
        camera = street.camera("front_camera", int(time), street.ego.shifted(lateral=1.0, forward=forward))
        needs.append(far_from_photos(street, camera, torch.full((54, 96), 10.0))[24:30, 44:52])
    assert needs[0].min() > 0.6 and needs[1].max() < 0.1


def test_sky_needs_nothing_and_a_hole_without_a_sky_everything(street):
    with_sky, without = (render_frame(s, camera_of(street), ("need", "alpha")) for s in (street, replace(street, sky=None)))
    empty = with_sky.alpha < 1e-3
    assert empty.sum() > 100 and with_sky.need[empty].max() < 0.01 and without.need[empty].min() > 0.99


def test_a_panorama_is_supported_where_photos_look_only(street):
    camera = replace(camera_of(street), lens=Equirectangular.whole(96, 54))
    need = far_from_photos(street, camera, torch.full((54, 96), 10.0))
    behind = torch.cat([need[24:30, :6], need[24:30, -6:]], 1)
    assert need[24:30, 42:54].max() == 0 and behind.min() == 1  # the cameras look ahead and to the left
    assert need[24:30, 20:28].max() < 0.1 and need[24:30, 76:].min() == 1


def test_what_was_inserted_needs_everything(street):
    camera = camera_of(street)
    (actor,) = street.actors
    inserted = replace(street, actors=(replace(actor, asset=replace(actor.asset, meta={**actor.asset.meta, "inserted": True})),))
    recorded, anew = (render_frame(s, camera, ("need", "instance", "rgb")) for s in (street, inserted))
    own = anew.instance == 1
    assert own.sum() > 20 and (anew.need[own] == 1).all()
    assert recorded.need[own].mean() < 0.9
    darker = ((recorded.rgb - anew.rgb).abs().sum(-1) > 0) & ~own
    assert (anew.need[darker] == 1).all()


def test_needles_and_blots_are_told_from_splats():
    log_scales = torch.tensor([[-3.0, -3.0, -3.0], [0.5, -3.5, -3.5], [0.0, 0.0, -6.0]])
    g = random_splats(3, 0)
    g = Gaussians(torch.tensor([[0, 0, 5.0]] * 3), g.quats, log_scales, g.logit_opacities, g.sh)
    (fields,) = support_fields([Placed(g, NEVER)], Camera(Pinhole(500.0, 500.0, 50.0, 50.0), 100, 100, NEVER))
    assert fields[0].tolist() == [0, 0]
    assert fields[1, 0] < 0.1 and fields[1, 1] == 1
    assert fields[2, 0] == 1 and fields[2, 1] == 0


def test_a_clip_tells_what_the_frames_before_and_after_see(street):
    times = street.frame_times("front_camera")[:3]
    outputs = ("rgb", "need", "visible_prev", "visible_next", "normal", "median_depth", "instance_alpha")
    first, second, third = render_clip(street, "front_camera", times_us=times, outputs=outputs, shadows=False)
    assert first.visible_prev is None and third.visible_next is None
    assert second.visible_prev.dtype == torch.bool and 0.5 < second.visible_prev.float().mean() <= 1
    assert second.instance_alpha.shape == (54, 96, 2)


def test_need_is_not_asked_of_splats_without_a_scene():
    camera = Camera(Pinhole(20.0, 20.0, 10.0, 10.0), 20, 20, translation(0, 0, -5))
    with pytest.raises(ValueError, match="render_frame"):
        rasterize(random_splats(3, 0), camera, ("need",))


def scene_by_lot(dice: random.Random, sky) -> Scene:
    """Splats of all shapes, and before them a thing that was recorded or inserted; a rig of two cameras that took two photos each."""
    seed = dice.randrange(1000)
    cloud, few = (random_splats(count, seed) for count in (100, 30))
    shapes = [1.2 * torch.randn(len(g), 3, generator=torch.Generator().manual_seed(seed)) for g in (cloud, few)]
    cloud, few = (replace(g, log_scales=g.log_scales + shape) for g, shape in zip((cloud, few), shapes, strict=True))
    stands = pose_from([1, 0.1, dice.uniform(-1, 1), 0], [dice.uniform(-2, 2), dice.uniform(-1, 1), dice.uniform(2.5, 4)])
    asset = Asset(replace(few, means=0.4 * few.means), (1.0, 1.0, 1.0), "car", meta={"inserted": dice.random() < 0.7})
    times, lens = torch.tensor([0, 500_000]), Pinhole(48.0, 48.0, 28.0, 20.0)
    mounts = {"front": pose_from([1, 0, 0, 0], [0.1, 0, 0]), "side": pose_from([1, 0, dice.uniform(-1, 1), 0], [0.1, 0, 0])}
    rig = {name: RigCamera(lens, WIDTH, HEIGHT, mount, times_us=times) for name, mount in mounts.items()}
    ego = Trajectory(times, torch.stack([translation(), translation(0.2, 0.0, dice.uniform(-0.5, 1.5))]))
    background = Placed(cloud, pose_from([1, 0.1, 0.2, 0.05], [0.1, 0.2, 6.0]))
    return Scene(background, (Actor(asset, Trajectory(torch.tensor([0]), stands[None]), "a"),), sky, ego, rig)


def needed(scene: Scene, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Need `[H, W]` by its definition, of the oracle's picture, and where that is sure."""
    placed = scene.placed(camera.time_us)
    truth = oracle.as_oracle(placed)
    for (fields, *_), p in zip(truth, placed, strict=True):
        axes = p.gaussians.log_scales.double().exp().sort(1).values
        pose = inverse(camera.world_from_cam) @ p.world_from_local
        depth = camera.lens.depth(p.gaussians.means.double() @ pose[:3, :3].T + pose[:3, 3])
        sigma = max(camera.lens.focal()) * axes[:, 1] / depth.clamp_min(0.1)
        fields["features"] = torch.stack([smooth(sigma, COARSE), smooth(axes[:, 2] / axes[:, 1], STRETCHED)], 1)
    with torch.no_grad():
        _, alpha, depth, instance, unsure, unfit = oracle.render(
            truth, camera, scene.model_for(camera), cutoff=1 / 255, alpha_max=0.999, features=True
        )
    eye, ahead = camera.world_from_cam[:3, 3], camera.world_from_cam[:3, 2]
    sight = camera.lens.unproject(camera.pixel_centres()) @ camera.world_from_cam[:3, :3].T
    points = eye + sight * depth.where(alpha > 0, 1.0)[..., None]
    looks = sight if camera.lens.limit() > math.pi / 2 else ahead.expand_as(sight)
    aside = torch.full_like(depth, math.pi)
    for photo in (scene.camera(name, int(t)).world_from_cam for name in scene.rig for t in scene.frame_times(name)):
        seen = angle(looks, photo[:3, 2]) < math.acos(FACING)
        aside = torch.where(seen, torch.minimum(aside, angle(eye - points, photo[:3, 3] - points)), aside)
    holes = 1 - alpha if scene.sky is None else 4 * alpha * (1 - alpha)
    put_in = torch.isin(instance, torch.tensor(scene.anew()))
    supported = (1 - alpha * smooth(aside, ASIDE)) * (1 - holes) * (1 - unfit.clamp(0, 1)).prod(-1) * ~put_in
    return 1 - supported, ~unsure & ((alpha - 0.5).abs() > 1e-4)


def smooth(value: torch.Tensor, span: tuple[float, float]) -> torch.Tensor:
    u = ((value - span[0]) / (span[1] - span[0])).clamp(0, 1)
    return 3 * u**2 - 2 * u**3


def angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.atan2(torch.linalg.cross(a, b.expand_as(a)).norm(dim=-1), (a * b).sum(-1))


@pytest.mark.parametrize("seed", range(8))
def test_need_of_scenes_by_lot_is_what_it_is_defined_to_be(street, seed):
    dice = random.Random(seed)
    scene = scene_by_lot(dice, dice.choice([None, street.sky]))
    lens = dice.choice([PINHOLE, LENSES["opencv"], LENSES["fisheye"], LENSES["equirectangular"]])
    pose = pose_from([1, dice.uniform(-0.05, 0.05), dice.uniform(-0.3, 0.3), 0], [dice.uniform(-1.5, 1.5), 0.1, dice.uniform(-0.5, 0.5)])
    camera = Camera(lens, WIDTH, HEIGHT, pose)
    wanted, sure = needed(scene, camera)
    found = render_frame(scene, camera, ("need",), shadows=False, config=RenderConfig(termination=0)).need
    assert sure.float().mean() > 0.9 and wanted.max() - wanted.min() > 0.5
    assert largest(found, wanted, sure) < 1e-5, lens.kind
