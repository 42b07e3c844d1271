import gc
import weakref
from dataclasses import replace

import pytest
import torch
from street import START_US, STEP_US

from render import render_clip, render_frame
from render.clip import clip_cameras, clip_times, cut_warning, frame_rate
from scenes import Trajectory


def test_a_clip_has_the_recorded_frames(street):
    frames = list(render_clip(street, "front_camera", times_us=street.frame_times("front_camera")[:3]))
    assert [f.camera.time_us for f in frames] == [START_US, START_US + STEP_US, START_US + 2 * STEP_US]
    assert torch.equal(frames[1].rgb, render_frame(street, street.camera("front_camera", START_US + STEP_US)).rgb)


def test_a_positive_shift_moves_every_camera_to_the_left_of_travel(street):
    for name in street.rig:
        recorded, shifted = clip_cameras(street, name), clip_cameras(street, name, shift=2)
        for a, b in zip(recorded, shifted, strict=True):
            assert (b.world_from_cam[:3, 3] - a.world_from_cam[:3, 3]).tolist() == pytest.approx([0, 2, 0])
            assert torch.allclose(a.world_from_cam[:3, :3], b.world_from_cam[:3, :3])


def test_a_clip_that_would_last_longer_than_the_recording_says_so(street):
    assert cut_warning(street, "front_camera", 0, None) == [] == cut_warning(street, "front_camera", 0, 800_000)
    assert cut_warning(street, "front_camera", 300_000, 500_000) == []
    (said,) = cut_warning(street, "front_camera", 300_000, 700_000)
    assert "--duration 0.7s goes beyond the recording: front_camera has 0.5s from there" in said


def test_any_path_of_the_body_can_be_driven(street):
    path = Trajectory(street.ego.times_us, street.ego.shifted(vertical=3).world_from_body)
    (camera,) = clip_cameras(street, "front_camera", path, times_us=[START_US])
    assert float(camera.world_from_cam[2, 3]) == pytest.approx(4.5)


def test_the_left_of_the_road_comes_nearer_when_shifted_left(street):
    left = next(render_clip(street, "front_camera", 2, outputs=("depth",))).depth
    right = next(render_clip(street, "front_camera", -2, outputs=("depth",))).depth
    assert left[20, 4] < right[20, 4]
    assert left[20, -4] > right[20, -4]


def test_flow_links_neighbouring_frames_of_the_clip(street):
    times = street.frame_times("front_camera")[:3]
    frames = list(render_clip(street, "front_camera", 1.0, times, outputs=("flow_prev", "flow_next")))
    assert frames[0].flow_prev is None and frames[-1].flow_next is None
    assert all(f is not None for f in (frames[0].flow_next, frames[1].flow_prev, frames[1].flow_next, frames[2].flow_prev))
    assert frames[1].flow_next[-1, 80, 0] > 0  # the road runs outwards and down as the car drives on
    assert frames[1].flow_prev[-1, 80, 0] < 0


def test_other_sizes_show_the_same_view(street):
    (small,) = render_clip(street, "front_camera", times_us=[START_US])
    (large,) = render_clip(street, "front_camera", times_us=[START_US], width=192, height=108)
    assert large.rgb.shape == (108, 192, 3)
    halved = large.rgb.reshape(54, 2, 96, 2, 3).mean((1, 3))
    assert (halved - small.rgb).abs().mean() < 0.02


def test_frames_are_not_kept(street):
    stream = render_clip(street, "front_camera")
    first = next(stream)
    gone = weakref.ref(first.rgb)
    del first
    next(stream)
    gc.collect()
    assert gone() is None


def test_wrong_arguments_are_refused_before_the_first_frame(street):
    with pytest.raises(ValueError, match="Did you mean front_camera"):
        render_clip(street, "front_camra")
    with pytest.raises(ValueError, match="Did you mean depth"):
        render_clip(street, "front_camera", outputs=("deepth",))
    with pytest.raises(ValueError, match="at least one frame"):
        render_clip(street, "front_camera", times_us=[])
    with pytest.raises(ValueError, match="outside the trajectory"):
        render_clip(street, "front_camera", times_us=[0])
    with pytest.raises(ValueError, match="times_us must be whole microseconds, got 0.5; seconds times 1e6"):
        render_clip(street, "front_camera", times_us=[0.5])
    with pytest.raises(ValueError, match=r"times_us must be a list of times, as \[t\] of one, got 1000"):
        render_clip(street, "front_camera", times_us=1000)
    with pytest.raises(ValueError, match="go together"):
        render_clip(street, "front_camera", width=64)
    with pytest.raises(ValueError, match="whole numbers of at least 1x1 pixels, got 0x0"):
        render_clip(street, "front_camera", width=0, height=0)
    for shift, said in (("2m", "'2m'"), (float("nan"), "nan"), (-float("inf"), "-inf"), (None, "None")):
        with pytest.raises(ValueError, match=f"shift must be a finite number of metres to the left, or a Trajectory, got {said}"):
            render_clip(street, "front_camera", shift=shift)


def test_a_clip_can_start_later_and_end_earlier(street):
    assert (clip_times(street, "front_camera", 200_000, 300_000) - START_US).tolist() == [200_000, 300_000, 400_000]
    assert len(clip_times(street, "front_camera")) == 8


def shaken(street, *offsets_us):
    """The street, with the stamps of its front camera off by so much."""
    front = street.rig["front_camera"]
    return replace(street, rig=street.rig | {"front_camera": replace(front, times_us=front.times_us + torch.tensor(offsets_us))})


@pytest.mark.parametrize(
    "offsets", [[0] * 8, [-30 * i for i in range(8)], [30 * i for i in range(8)], [0, 9000, -9000, 9000, -9000, 9000, -9000, 9000]]
)
def test_stamps_that_shake_neither_add_a_frame_nor_drop_one(street, offsets):
    scene = shaken(street, *offsets)
    stamps = scene.frame_times("front_camera")
    for first, last in [(0, 1), (0, 5), (2, 3), (2, 6), (0, 8), (5, 8)]:
        start, lasts = first * STEP_US, (last - first) * STEP_US
        assert torch.equal(clip_times(scene, "front_camera", start, lasts), stamps[first:last])
        assert cut_warning(scene, "front_camera", start, lasts) == []
    assert torch.equal(clip_times(scene, "front_camera", 3 * STEP_US), stamps[3:])
    assert len(cut_warning(scene, "front_camera", 0, 9 * STEP_US)) == 1


def test_a_clip_of_a_moment_has_one_frame_and_one_of_none_none(street):
    scene = shaken(street, 0, 0, -300, 300, 0, 0, 0, 0)
    for i in (0, 2, 3):
        assert len(clip_times(scene, "front_camera", i * STEP_US, 1000)) == 1
        with pytest.raises(ValueError, match="leaves no frame"):
            clip_times(scene, "front_camera", i * STEP_US, 0)


def test_a_clip_can_run_at_another_rate(street):
    times = clip_times(street, "front_camera", 0, 500_000, fps=20)
    assert (times - START_US).tolist() == list(range(0, 500_000, 50_000))
    assert frame_rate(times) == pytest.approx(20)


@pytest.mark.parametrize(("start", "duration"), [(20_000_000, None), (0, 0), (-5_000_000, 1_000_000)])
def test_a_clip_without_frames_is_refused(street, start, duration):
    with pytest.raises(ValueError, match="8 frames over 0.7s"):
        clip_times(street, "front_camera", start, duration)


def test_a_clip_cannot_begin_before_the_first_frame_at_any_rate(street):
    with pytest.raises(ValueError, match="--start -1s lies before the first frame"):
        clip_times(street, "front_camera", -1_000_000, 5_000_000, fps=20)
