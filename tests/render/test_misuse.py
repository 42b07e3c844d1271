"""What the rasterizer is given wrongly, or in another form: refused, or drawn alike."""

from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from render.captured import Captured
from render.room import Room
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.camera import neutral_exposure
from scenes.poses import translation
from tests.bench.presets import random_splats

CAMERA = Camera(Pinhole(60.0, 62.0, 34.0, 22.0), 70, 50, torch.eye(4, dtype=torch.float64))


def ahead() -> Gaussians:
    """Splats 6 m before the camera."""
    splats = random_splats(40, 0)
    return replace(splats, means=splats.means + torch.tensor([0.0, 0.0, 6.0]))


def test_splats_written_to_between_forward_and_backward_are_refused():
    splats = Gaussians(*(t.clone().requires_grad_() for t in ahead().tensors().values()))
    frame = rasterize(splats, CAMERA)
    with torch.no_grad():
        splats.log_scales.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        frame.rgb.sum().backward()


def test_a_gradient_of_gradients_is_refused_and_not_silently_left_out():
    splats = Gaussians(*(t.clone().requires_grad_() for t in ahead().tensors().values()))
    loss = rasterize(splats, CAMERA).rgb.square().sum()
    (slope,) = torch.autograd.grad(loss, splats.means, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        (loss + slope.square().sum()).backward()


def test_splats_made_in_inference_mode_are_drawn_alike():
    with torch.inference_mode():
        made = Gaussians(*(t.clone() for t in ahead().tensors().values()))
    assert torch.equal(rasterize(made, CAMERA).rgb, rasterize(ahead(), CAMERA).rgb)


def test_a_background_may_be_a_list_and_flow_may_go_to_splats_alone():
    splats = ahead()
    assert torch.equal(rasterize(splats, CAMERA, background=[1, 0, 0]).rgb, rasterize(splats, CAMERA, background=torch.eye(3)[0]).rgb)
    frame = rasterize(splats, CAMERA, ("flow_next",), flow_to={"next": (splats, CAMERA)})
    assert frame.flow_next.abs().max() < 1e-4


def test_instances_that_share_an_id_and_move_differently_have_no_flow():
    splats, still = ahead(), torch.eye(4, dtype=torch.float64)
    now = [Placed(splats, still), Placed(splats, still)]
    apart = [Placed(splats, translation(-0.5, 0.0, 0.0)), Placed(splats, still)]
    with pytest.raises(ValueError, match="instance id 0 and move differently"):
        rasterize(now, CAMERA, ("flow_next",), flow_to={"next": (apart, CAMERA)})
    together = [apart[0], apart[0]]
    rasterize(now, CAMERA, ("flow_next",), flow_to={"next": (together, CAMERA)})
    own = [replace(p, instance=i) for i, p in enumerate(apart)]
    rasterize([replace(p, instance=i) for i, p in enumerate(now)], CAMERA, ("flow_next",), flow_to={"next": (own, CAMERA)})


def test_where_flow_goes_is_checked_as_the_view_itself():
    splats = ahead()
    lost = replace(CAMERA, world_from_cam=torch.full((4, 4), torch.nan, dtype=torch.float64))
    with pytest.raises(ValueError, match="pose of camera is not finite"):
        rasterize(splats, CAMERA, ("flow_next",), flow_to={"next": (splats, lost)})


def test_what_can_be_gone_through_once_only_is_drawn_as_a_list_is():
    still = torch.eye(4, dtype=torch.float64)
    placed, fields = [Placed(ahead(), still), Placed(ahead(), still, instance=1)], [torch.ones(40, 2), torch.zeros(40, 2)]
    outputs = ("rgb", "depth", "features")
    twice = rasterize((p for p in placed), (c for c in [CAMERA, CAMERA]), (o for o in outputs), features=(f for f in fields))
    assert list(twice[0].outputs()) == list(outputs)
    for frame in twice:
        assert torch.equal(frame.features, rasterize(placed, CAMERA, outputs, features=fields).features)


def test_a_pose_that_is_by_columns_is_refused_and_not_drawn_from_the_origin():
    by_columns = translation(1.0, 0.0, 0.0).T
    with pytest.raises(ValueError, match="pose of camera has a bottom row other than 0 0 0 1; transpose it"):
        rasterize(ahead(), replace(CAMERA, world_from_cam=by_columns))
    with pytest.raises(ValueError, match="pose of instance 3 has a bottom row"):
        rasterize(Placed(ahead(), by_columns, instance=3), CAMERA)


def test_end_poses_that_scale_are_refused_as_poses_are():
    rows = replace(CAMERA, shutter="rows")
    twice = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="end pose of camera scales or shears"):
        rasterize(ahead(), replace(rows, world_from_cam_end=twice))
    with pytest.raises(ValueError, match="end pose of instance 2 scales or shears"):
        rasterize(Placed(ahead(), torch.eye(4, dtype=torch.float64), twice, instance=2), rows)


@pytest.mark.parametrize("axis", range(3))
def test_poses_that_mirror_are_refused_and_those_that_turn_two_axes_round_are_not(axis):
    mirror = torch.eye(4, dtype=torch.float64)
    mirror[axis, axis] = -1.0
    with pytest.raises(ValueError, match="the pose of camera mirrors.*turn both y and z round, not one of them"):
        rasterize(ahead(), replace(CAMERA, world_from_cam=mirror))
    with pytest.raises(ValueError, match="the end pose of instance 2 mirrors"):
        rasterize(Placed(ahead(), torch.eye(4, dtype=torch.float64), mirror, instance=2), replace(CAMERA, shutter="rows"))
    rasterize(ahead(), replace(CAMERA, world_from_cam=-mirror @ torch.diag(torch.tensor([1.0, 1, 1, -1], dtype=torch.float64))))


def test_a_recording_refuses_what_rasterize_refuses():
    splats, twice = ahead(), torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="instance ids must lie between"):
        Captured(Placed(splats, torch.eye(4, dtype=torch.float64), instance=-5), CAMERA)
    with pytest.raises(ValueError, match="background must have shape"):
        Captured(splats, CAMERA, background=torch.ones(4, 4))
    with pytest.raises(ValueError, match="pose of camera scales"):
        list(Captured(splats, CAMERA).frames([replace(CAMERA, world_from_cam=twice)]))
    (frame,) = Captured(splats, CAMERA, background=[1.0, 0.0, 0.0]).frames([CAMERA])
    assert torch.equal(frame.rgb, rasterize(splats, CAMERA, background=[1.0, 0.0, 0.0]).rgb)


@pytest.fixture
def doubles():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


EVERYTHING = ("rgb", "alpha", "depth", "median_depth", "normal", "features", "flow_next", "visible_next", "instance", "instance_alpha")


@pytest.mark.parametrize("order", ["tile", "pixel"])
def test_what_torch_makes_by_default_changes_nothing(order, request):
    made = ahead()

    def drawn() -> list[torch.Tensor]:
        splats = made.map(lambda t: t.clone().requires_grad_())
        flow_to = {"next": (splats, replace(CAMERA, world_from_cam=translation(0.1, 0.0, 0.0)))}
        features = torch.ones(40, 2, dtype=torch.float32)
        frame = rasterize(splats, CAMERA, EVERYTHING, flow_to=flow_to, features=features, config=RenderConfig(order=order))
        frame.rgb.sum().backward()
        return [*frame.outputs().values(), *(t.grad for t in splats.tensors().values())]

    expected = drawn()
    request.getfixturevalue("doubles")
    for mine, same in zip(drawn(), expected, strict=True):
        assert mine.dtype == same.dtype and torch.equal(mine, same)
    assert len(rasterize([], CAMERA, ("rgb",)).rgb) == CAMERA.height and neutral_exposure().dtype == torch.float32


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: rasterize([ahead(), ahead()], CAMERA), "must be of Placed, got Gaussians"),
        (lambda: RenderConfig(max_error=0.01, order="tile"), 'max_error is kept in order "pixel" only'),
        (lambda: RenderConfig(order="depth"), 'order must be "tile" or "pixel"'),
        (lambda: Placed(ahead(), torch.eye(4, dtype=torch.float64), instance=1.5), "instance must be a whole number, got 1.5"),
        (lambda: replace(CAMERA, width=43.5), "whole numbers of at least 1x1 pixels, got 43.5x50"),
        (lambda: SplatModel(dilation=float("inf")), "dilation must be at least 0 px.2 and finite"),
        (
            lambda: rasterize(ahead().map(lambda t: t.clone().requires_grad_()), CAMERA, room=Room()),
            "room= takes no gradients",
        ),
    ],
)
def test_what_would_be_drawn_otherwise_than_asked_for_is_refused(make, why):
    with pytest.raises(ValueError, match=why):
        make()


def test_a_crop_may_be_a_list():
    assert torch.equal(rasterize(ahead(), CAMERA, crop=[5, 6, 20, 10]).rgb, rasterize(ahead(), CAMERA).rgb[6:16, 5:25])
