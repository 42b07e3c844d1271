"""Frames drawn in room that earlier frames needed: nobody waits for a count, and nobody sees a frame that lacked room."""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from render import RenderConfig, rasterize, render_clip
from render.captured import Captured
from render.room import Room, one_ahead
from scenes import Camera, SplatModel
from scenes.poses import translation
from tests.render.test_cuda import ON_A_GPU
from tests.render.test_rasterize import CAMERA, two_instances

OUTPUTS = ("rgb", "alpha", "depth", "median_depth", "instance")


def path(count: int) -> list[Camera]:
    """Ever nearer to the splats, so that they cover ever more tiles."""
    return [replace(CAMERA, world_from_cam=translation(0.02 * i, 0, 0.5 * i) @ CAMERA.world_from_cam) for i in range(count)]


def same(a, b) -> bool:
    return all(torch.equal(getattr(a, name).cpu(), getattr(b, name).cpu()) for name in OUTPUTS)


def test_frames_drawn_in_too_little_room_are_drawn_again_and_are_the_same_bits():
    placed, room, times = two_instances(1), Room(entries=10), []

    def draw(camera: Camera):
        times.append(room.entries)
        return rasterize(placed, camera, OUTPUTS, room=room)

    drawn = list(one_ahead(draw, path(5), room))
    assert all(same(frame, rasterize(placed, frame.camera, OUTPUTS)) for frame in drawn)
    assert len(drawn) == 5 < len(times) < 12 and times[-1] > 100
    assert times == sorted(times), "room that was needed once may be needed again"


def test_with_room_every_frame_is_drawn_once_and_one_ahead_of_what_is_given_out():
    room, begun = Room(entries=100), []

    def draw(job: int) -> int:
        begun.append(job)
        room.note(torch.tensor(100))
        return -job

    stream = one_ahead(draw, range(3), room)
    assert next(stream) == 0 and begun == [0, 1]
    assert list(stream) == [-1, -2] and begun == [0, 1, 2] and room.entries == 100


def test_a_frame_without_splats_needs_no_room():
    assert list(one_ahead(lambda job: job, [7], Room(1))) == [7]


class NoQuestions(TorchDispatchMode):
    """Fails where a number is read from a tensor, or a shape depends on what one holds."""

    ASKS = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert not any(name in str(func) for name in self.ASKS), f"{func} waits for the device"
        return func(*args, **(kwargs or {}))


def test_what_a_graph_records_asks_the_device_nothing():
    captured = Captured(two_instances(1), CAMERA, OUTPUTS, background=torch.ones(3))
    with NoQuestions():
        captured._paint()


def test_recorded_frames_are_the_bits_of_frames_drawn_one_by_one():
    placed, background = two_instances(2), torch.tensor([0.1, 0.2, 0.3])
    captured = Captured(placed, CAMERA, OUTPUTS, background, room=Room(200))
    for frame in captured.frames(path(4)):
        assert same(frame, rasterize(placed, frame.camera, OUTPUTS, background))


def test_what_cannot_be_recorded_is_refused():
    placed = two_instances(1)
    with pytest.raises(ValueError, match='"normal" cannot be captured'):
        Captured(placed, CAMERA, ("normal",))
    with pytest.raises(ValueError, match='order "pixel" cannot be captured'):
        Captured(placed, CAMERA, model=SplatModel(), config=RenderConfig(max_error=1 / 255))
    with pytest.raises(ValueError, match="must share lens, size"):
        list(Captured(placed, CAMERA).frames([CAMERA.resized(32, 24)]))


@ON_A_GPU
def test_a_gpu_replays_a_clip_as_it_draws_it_and_nothing_waits_for_it():
    placed = [replace(p, gaussians=p.gaussians.to("cuda")) for p in two_instances(1)]
    captured = Captured(placed, CAMERA, OUTPUTS, room=Room(10))
    drawn = list(captured.frames(path(6)))  # finds its room
    assert all(same(frame, rasterize(placed, frame.camera, OUTPUTS)) for frame in drawn)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for camera in path(6):
            captured._draw(camera)
            rasterize(placed, camera, OUTPUTS, room=captured.room)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@ON_A_GPU
def test_a_clip_on_a_gpu_is_the_clip_on_the_cpu(street):
    there = [f.rgb.cpu() for f in render_clip(street.to("cuda"), next(iter(street.rig)))]
    for here, frame in zip(render_clip(street, next(iter(street.rig))), there, strict=True):
        assert (here.rgb - frame).abs().mean() < 1e-4
