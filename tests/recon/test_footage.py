"""Which frames of a video are taken, and what of each."""

import numpy as np
import pytest
import torch
from PIL import Image

from recon.readers import footage
from recon.readers.footage import take_frames
from render.video import VideoWriter

H, W = 72, 128
GRAIN = torch.from_numpy(np.random.default_rng(0).random((9, 96, 3))).float().repeat_interleave(8, 0).repeat_interleave(8, 1)


def street(i: int) -> torch.Tensor:
    """What a camera sees that goes along a painted wall, 3 pixels a frame."""
    return 0.2 + 0.8 * GRAIN[:, 3 * i : 3 * i + W]


def written(path, frames, fps=10, crf=18):
    with VideoWriter(path, fps, W, H, crf=crf) as video:
        for frame in frames:
            video.write(frame)
    return path


def test_frames_that_repeat_the_one_before_or_show_nothing_are_left_out(tmp_path, capsys):
    black, shown = torch.zeros(H, W, 3), [0, 1, 1, 2, 4, 4, 4, 5]
    taken = take_frames(written(tmp_path / "a.mp4", [black, black, *map(street, shown)], crf=28), tmp_path / "frames")
    assert list(taken.times.values()) == [200_000, 300_000, 500_000, 600_000, 900_000]
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == list(taken.times)
    assert "a.mp4: frames left out: 3 that repeat the one before, 2 that show nothing" in capsys.readouterr().err


@pytest.mark.parametrize("fps", [20, 60])
def test_what_a_recorder_repeats_between_due_frames_takes_no_time_off_them(tmp_path, fps):
    frames = [street(i) for i in range(12) for _ in range(fps // 10)]
    taken = take_frames(written(tmp_path / "a.mp4", frames, fps), tmp_path / "frames")
    assert list(taken.times.values()) == [100_000 * i for i in range(12)] and taken.repeats == 0


def test_something_small_that_moves_before_a_standing_camera_is_no_repeat(tmp_path):
    def with_walker(i):
        frame = street(0).clone()
        frame[40:56, 4 * i : 4 * i + 8] = 0
        return frame

    taken = take_frames(written(tmp_path / "a.mp4", map(with_walker, range(6))), tmp_path / "frames")
    assert len(taken.times) == 6 and taken.repeats == 0


@pytest.mark.parametrize(("axis", "wide"), [(0, 10), (1, 20)], ids=["above and below", "aside"])
def test_black_bars_are_cut_off(tmp_path, capsys, axis, wide):
    def barred(i):
        frame = street(i).clone()
        for part in (frame.narrow(axis, 0, wide), frame.narrow(axis, frame.shape[axis] - wide, wide)):
            part.zero_()
        return frame

    take_frames(written(tmp_path / "a.mp4", map(barred, range(5))), tmp_path / "frames")
    size = [H, W]
    size[axis] -= 2 * wide
    for file in (tmp_path / "frames").iterdir():
        picture = np.array(Image.open(file))
        assert all(side - 4 <= got <= side for side, got in zip(size, picture.shape, strict=False)), picture.shape
        assert min(picture.mean((1 - axis, 2))) > 60  # of what is left of bars, half a line
    assert "black bars around its pictures are left out" in capsys.readouterr().err


def test_a_dark_sky_is_no_bar(tmp_path):
    def night(i):
        frame = street(i).clone()
        frame[:20] = 0.02
        return frame

    take_frames(written(tmp_path / "a.mp4", map(night, range(4))), tmp_path / "frames")
    assert all(Image.open(file).size == (W, H) for file in (tmp_path / "frames").iterdir())


def test_a_part_of_a_long_video_has_frames_as_close_as_a_short_one(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(footage, "MOST", 4)
    file = written(tmp_path / "long.mp4", map(street, range(30)), fps=10)
    whole = take_frames(file, tmp_path / "whole")
    assert list(whole.times.values()) == [0, 700_000, 1_400_000, 2_100_000, 2_800_000]
    told = "long.mp4: of 3 s a frame every 0.8 s is taken, between which a car goes far; give --start and a --duration of up to 2s"
    assert told in capsys.readouterr().err
    part = take_frames(file, tmp_path / "part", 1_000_000, 400_000)
    assert list(part.times.values()) == [1_000_000, 1_100_000, 1_200_000, 1_300_000] and part.count == 4
    assert capsys.readouterr().err == ""
    with pytest.raises(ValueError, match="start 3s is outside .*long.mp4, which lasts 3s"):
        take_frames(file, tmp_path / "none", 3_000_000)
    with pytest.raises(ValueError, match="duration 0s must be positive; .*long.mp4 lasts 3s"):
        take_frames(file, tmp_path / "none", 0, 0)
