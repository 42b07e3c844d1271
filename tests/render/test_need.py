"""Need: nothing where a photo stood, more the further from it, everything where something was put."""

from dataclasses import replace

import pytest
import torch

from render import rasterize, render_clip, render_frame
from render.need import far_from_photos, support_fields
from scenes import Camera, Equirectangular, Gaussians, Pinhole, Placed
from scenes.poses import translation
from tests.bench.presets import random_splats

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
