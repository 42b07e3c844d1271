from dataclasses import replace

import pytest
import torch
from street import START_US, car

from render import rasterize, render_frame
from render.rays import world_directions
from scenes import Gaussians, Placed, Scene
from scenes.harmonics import rgb_from_sh
from scenes.insert import insert
from scenes.placement import Placement


@pytest.fixture(scope="module")
def camera(street):
    return street.camera("front_camera", START_US)


def empty(street: Scene) -> Scene:
    return replace(street, background=Placed(Gaussians.empty(), torch.eye(4, dtype=torch.float64)), actors=())


def test_what_was_not_asked_for_is_none(street, camera):
    frame = render_frame(street, camera, ("depth",))
    assert set(frame.outputs()) == {"depth"}
    assert set(render_frame(street, camera).outputs()) == {"rgb"}


def test_an_empty_scene_shows_the_sky(street, camera):
    frame = render_frame(empty(street), camera, ("rgb", "alpha"))
    assert torch.allclose(frame.rgb, street.sky.colour(world_directions(camera)))
    assert (frame.alpha == 0).all()


def test_up_is_blue_and_the_road_is_grey(street, camera):
    rgb = render_frame(street, camera).rgb
    top, bottom = rgb[0, 48], rgb[-1, 60]
    assert top[2] > top[0] + 0.1
    assert (bottom - bottom.mean()).abs().max() < 0.03


def test_a_scene_without_a_sky_is_black_where_nothing_stands(street, camera):
    frame = render_frame(replace(empty(street), sky=None), camera)
    assert (frame.rgb == 0).all()


def test_the_sky_is_behind_the_splats(street, camera):
    frame = render_frame(street, camera, ("rgb", "alpha"))
    bare = rasterize(street.placed(START_US), camera, ("rgb", "alpha"), model=street.model)
    assert torch.equal(frame.alpha, bare.alpha)
    opaque = bare.alpha > 0.999
    assert torch.equal(frame.rgb[opaque], bare.rgb[opaque])
    expected = bare.rgb + (1 - bare.alpha)[..., None] * street.sky.colour(world_directions(camera))
    assert (frame.rgb - expected).abs().max() < 0.003  # the sky is left out where under 1/512 of it shows


def test_exposure_comes_last(street, camera):
    affine = torch.tensor([[0.5, 0.1, 0.0, 0.02], [0.0, 0.7, 0.0, 0.0], [0.0, 0.2, 0.9, -0.01]])
    plain = render_frame(street, replace(camera, exposure=None)).rgb
    exposed = render_frame(street, replace(camera, exposure=affine)).rgb
    assert torch.allclose(exposed, plain @ affine[:, :3].T + affine[:, 3], atol=1e-6)


def test_actors_stand_where_they_are_at_that_time(street):
    early = render_frame(street, street.camera("front_camera", START_US), ("instance",)).instance
    late = render_frame(street, street.camera("front_camera", START_US + 700_000), ("instance",)).instance
    assert 0 < (early == 1).sum() < (late == 1).sum()  # it comes nearer


def test_light_follows_what_was_recorded_and_not_what_was_put_in(street):
    """One camera of two exposed a frame four times as much: in the mean twice."""
    rig = {name: replace(c, gains=None) for name, c in street.rig.items()}
    gains = torch.ones(len(rig["front_camera"].times_us), 3)
    gains[0] = 4.0
    scene = insert(replace(street, rig=rig), car(), Placement("car", 20, 5)).scene
    lit = replace(scene, rig={**rig, "front_camera": replace(rig["front_camera"], gains=gains)})
    torch.testing.assert_close(lit.followed(START_US), torch.full((3,), 2.0))
    (_, *before), (_, *after) = (s.placed(START_US) for s in (scene, lit))
    assert not torch.equal(before[0].gaussians.sh, after[0].gaussians.sh) and torch.equal(before[1].gaussians.sh, after[1].gaussians.sh)
    torch.testing.assert_close(rgb_from_sh(after[0].gaussians.sh[:, 0]), rgb_from_sh(before[0].gaussians.sh[:, 0]) / 2)


def test_flow_needs_the_other_camera(street, camera):
    with pytest.raises(ValueError, match="pass previous="):
        render_frame(street, camera, ("rgb", "flow_prev"))


def test_the_sky_flows_by_rotation_only(street, camera):
    moved = street.camera("front_camera", START_US + 400_000)
    frame = render_frame(street, camera, ("flow_next", "alpha"), following=moved)
    sky = frame.alpha < 0.4
    assert sky.any()
    assert frame.flow_next[sky].abs().max() < 1e-3  # the car goes straight ahead
    assert frame.flow_next[~sky].abs().max() > 1


def test_unknown_outputs_name_the_nearest(street, camera):
    with pytest.raises(ValueError, match="Did you mean depth"):
        render_frame(street, camera, ("dept",))


def test_gradients_reach_the_splats_and_the_sky(street, camera):
    colour = street.sky.linear.clone().requires_grad_()
    sh = street.background.gaussians.sh.clone().requires_grad_()
    background = Placed(replace(street.background.gaussians, sh=sh), street.background.world_from_local)
    scene = replace(street, sky=replace(street.sky, linear=colour), background=background)
    render_frame(scene, replace(camera, exposure=torch.eye(3, 4) * 0.9)).rgb.sum().backward()
    assert colour.grad.abs().sum() > 0
    assert sh.grad.abs().sum() > 0


def test_a_contact_shadow_darkens_the_ground_below_an_inserted_asset_only(street, camera):
    scene = insert(street, car(), Placement("car", 8, 2.2)).scene
    lit = render_frame(scene, camera, ("rgb", "instance"), shadows=False)
    shaded = render_frame(scene, camera, ("rgb", "instance"))
    darker = (lit.rgb - shaded.rgb).amax(-1) > 0.01
    assert darker.any()
    assert (lit.rgb >= shaded.rgb - 1e-6).all()
    rows, columns = (lit.instance == 2).nonzero().unbind(1)
    y, x = darker.nonzero().unbind(1)
    assert y.min() > rows.float().mean()  # low: of the asset itself only tyres and skirts
    assert x.min() >= columns.min() - 12 and x.max() <= columns.max() + 12  # near


def test_recorded_actors_keep_the_shadows_of_their_photos(street, camera):
    assert torch.equal(render_frame(street, camera).rgb, render_frame(street, camera, shadows=False).rgb)


def test_an_exposure_that_changes_nothing_yet_has_a_gradient(street, camera):
    exposure = torch.eye(3, 4).requires_grad_()
    render_frame(street, replace(camera, exposure=exposure)).rgb.sum().backward()
    assert (exposure.grad.abs() > 0).all()


def test_instance_alpha_has_a_channel_for_each_id_whoever_is_there(street):
    """What left the street takes no channel along: those of who comes after it would be taken for its own."""
    scene = insert(street, car(), Placement("car", 9, 2)).scene
    gone = replace(scene.actors[0].trajectory, times_us=scene.actors[0].trajectory.times_us - 10_000_000)
    scene = replace(scene, actors=(replace(scene.actors[0], trajectory=gone), *scene.actors[1:]))
    frame = render_frame(scene, scene.camera("front_camera", START_US), ("alpha", "instance", "instance_alpha"))
    assert frame.instance_alpha.shape == (54, 96, 3) and not frame.instance_alpha[..., 1].any()
    assert (frame.instance_alpha.sum(-1) - frame.alpha).abs().max() < 1e-5
    assert frame.instance_alpha[..., 2][frame.instance == 2].mean() > 0.9
