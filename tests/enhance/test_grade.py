"""Clips in other colours than their place has, graded as photos of it."""

import sys

import numpy as np
import pytest
import torch
from PIL import Image

from enhance.clip import enhance_video
from enhance.correcting.colour_map import Colours, Map
from enhance.correcting.grade import STEADY, Grade, Graded
from enhance.enhancer import Enhancer
from enhance.evaluate import GRADED, evaluate
from enhance.pairs.isp import Isp
from enhance.pairs.of_photos import make_photo_pairs
from enhance.pairs.shards import PairSet
from enhance.step import frame_of
from render.compare import psnr
from render.video import VideoWriter, read_image, write_image


class Asis:
    """An enhancer that gives frames back."""

    about, reads, device = {}, ("instance",), torch.device("cpu")

    def step(self, frame, memory=None):
        return (frame if isinstance(frame, torch.Tensor) else frame.rgb), memory


def place(seed: int, moment: int = 0, count: int = 40, size=(90, 160)) -> torch.Tensor:
    """A made-up view: blocks of soft colours before a bright sky, drawn a little further at each moment."""
    rng = np.random.default_rng(seed)
    h, w = size
    y, x = torch.meshgrid(torch.arange(h) / h, torch.arange(w) / w, indexing="ij")
    rgb = torch.stack([0.7 - 0.3 * y, 0.72 - 0.3 * y, 0.8 - 0.4 * y], -1)
    for _ in range(count):
        cx, cy, sx, sy = rng.uniform(0, 1), rng.uniform(0.3, 1), rng.uniform(0.03, 0.2), rng.uniform(0.03, 0.2)
        colour = torch.tensor(rng.uniform(0.05, 0.75, 3), dtype=torch.float32)
        inside = ((x - cx - 0.004 * moment).abs() < sx) & ((y - cy).abs() < sy)
        rgb[inside] = colour
    return rgb


def photos(seed: int, count: int = 6) -> list[torch.Tensor]:
    return [place(seed, moment) for moment in range(count)]


WARM = Isp(exposure=0.7, red=0.3, blue=-0.4, saturation=0.6, tone=0.4)


def altered(rgb: torch.Tensor, isp: Isp = WARM) -> torch.Tensor:
    return isp(rgb.permute(2, 0, 1)).permute(1, 2, 0)


def test_a_map_gives_colours_the_mean_and_covariance_that_are_wanted():
    draw = torch.Generator().manual_seed(0)
    given = torch.rand(5000, 3, generator=draw, dtype=torch.float64)
    wanted = Colours.of(0.2 + torch.rand(5000, 3, generator=draw) @ torch.tensor([[0.7, 0.1, 0], [0.1, 0.6, 0.1], [0, 0.1, 0.5]]))
    by = Map.between(Colours.of(given), wanted)
    mapped = Colours.of(given @ by.matrix.T + by.offset)
    torch.testing.assert_close(mapped.mean, wanted.mean, atol=1e-9, rtol=0)
    torch.testing.assert_close(mapped.spread, wanted.spread, atol=2e-4, rtol=0)  # FLAT
    torch.testing.assert_close(by.matrix, by.matrix.T)  # symmetric: it turns no colour into another
    assert by.changes(Colours.of(given)) == pytest.approx(float((given @ by.matrix.T + by.offset - given).square().mean()), rel=1e-9)


def test_a_whole_frame_in_other_colours_is_put_right():
    others, frame = photos(1), place(1, 7)
    better, _ = Graded(Asis(), Grade(others)).step(altered(frame))
    assert psnr(better, frame) > psnr(altered(frame), frame) + 8


def test_a_right_frame_stays_nearly_as_it_is():
    better, _ = Graded(Asis(), Grade(photos(1))).step(place(1, 7))
    assert psnr(better, place(1, 7)) > 45


def test_photos_of_what_the_frame_shows_are_what_counts():
    night = [altered(p, Isp(exposure=-3)) for p in photos(2)]
    graded = Graded(Asis(), Grade([*photos(1), *night]))
    for view in (place(1, 8), altered(place(2, 8), Isp(exposure=-3))):
        better, _ = graded.step(altered(view, Isp(exposure=0.8, blue=0.3)))
        assert psnr(better, view) > 25


def test_photos_that_are_there_once_more_do_not_say_what_is_usual():
    """As where a car stood: neighbours are alike to a level, and the clip was taken further on, where the place itself looks different."""
    drive = [altered(place(1, 4 * moment), Isp(exposure=0.03 * moment)) for moment in range(7)]
    photos, frame = [p for p in drive[:6] for _ in range(4)], drive[6]
    grade = Grade(photos)
    assert grade.usual(1.0) < 1e-6 < grade.usual(0.9)
    better, _ = Graded(Asis(), grade).step(frame)
    assert psnr(better, frame) > 45
    spoilt = altered(frame)
    assert psnr(Graded(Asis(), grade).step(spoilt)[0], frame) > psnr(spoilt, frame) + 8


def test_the_map_is_steady_over_a_clip_and_found_anew_after_a_cut():
    graded = Graded(Asis(), Grade([*photos(1), *photos(2)]))
    _, memory = graded.step(altered(place(1, 6)))
    first = memory.map
    for moment in range(7, 12):
        _, memory = graded.step(altered(place(1, moment)), memory)
    assert memory.count == 6 and memory.map.matrix.sub(first.matrix).abs().max() < 0.1
    _, after = graded.step(altered(place(2, 6), Isp(exposure=-1.5)), memory)
    _, alone = graded.step(altered(place(2, 6), Isp(exposure=-1.5)))
    assert after.count == 1 and torch.equal(after.map.matrix, alone.map.matrix)
    _, later = graded.step(place(1, 6)[:44], memory)  # of another size
    assert later.count == 1


def test_the_enhancer_behind_it_is_given_its_own_memory():
    class Counting(Asis):
        def step(self, frame, memory=None):
            return super().step(frame)[0], (memory or 0) + 1

    graded, memory = Graded(Counting(), Grade(photos(1))), None
    for _ in range(3):
        _, memory = graded.step(place(1), memory)
    assert memory.inner == 3


def test_what_is_told_to_have_been_put_in_does_not_count_and_is_graded_along():
    frame, ids = altered(place(1, 6)), torch.zeros(90, 160, dtype=torch.int64)
    ids[20:80, 40:120] = 1
    spoilt = torch.where(ids[..., None] > 0, torch.tensor([0.9, 0.2, 0.9]), frame)
    graded = Graded(Asis(), Grade(photos(1)))
    beside = ids == 0
    told = graded.step(frame_of(spoilt, ids))[0]
    untold = graded.step(spoilt)[0]
    assert psnr(told, place(1, 6), beside) > psnr(untold, place(1, 6), beside) + 3
    assert not torch.equal(told[ids > 0], spoilt[ids > 0])
    everything = graded.step(frame_of(frame, torch.ones_like(ids)))[0]
    assert torch.equal(everything, graded.step(frame)[0])  # where nothing is left to count, all does


def test_grey_and_tiny_frames_stay_finite():
    graded = Graded(Asis(), Grade(photos(1)))
    for frame in (torch.full((30, 40, 3), 0.5), torch.zeros(7, 5, 3), torch.ones(1, 1, 3), torch.rand(3, 301, 3)):
        better, _ = graded.step(frame)
        assert better.shape == frame.shape and torch.isfinite(better).all() and better.min() >= 0 and better.max() <= 1
    better, _ = Graded(Asis(), Grade([torch.full((20, 20, 3), 0.3)])).step(place(1))
    assert torch.isfinite(better).all()


def test_memory_stays_bounded_over_a_long_clip():
    graded, memory = Graded(Asis(), Grade(photos(1))), None
    for _ in range(STEADY + 5):
        _, memory = graded.step(altered(place(1)), memory)
    assert memory.count == STEADY


@pytest.mark.parametrize("source", ["folder", "video", "picture"])
def test_a_clip_is_given_the_colours_of_photos(tmp_path, source):
    (tmp_path / "clip").mkdir()
    (tmp_path / "photos").mkdir()
    for i in range(3):
        write_image(tmp_path / "clip" / f"{i}.png", altered(place(1, 6 + i)))
        write_image(tmp_path / "photos" / f"{i}.png", place(1, i))
    with VideoWriter(tmp_path / "photos.mp4", 10, 160, 90) as video:
        for i in range(9):
            video.write(place(1, i))
    like = {"folder": "photos", "video": "photos.mp4", "picture": "photos/2.png"}[source]
    assert enhance_video(tmp_path / "clip", tmp_path / "out", like=tmp_path / like) == (3, 3)
    for i in range(3):
        wanted = place(1, 6 + i)
        assert psnr(read_image(tmp_path / "out" / f"{i}.png"), wanted) > psnr(altered(wanted), wanted) + 6


def test_that_grey_photos_make_a_clip_grey_is_said(tmp_path, capsys):
    rgb = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(0))
    grey = rgb[..., :1].expand(-1, -1, 3)
    for name, picture in (("clip", rgb), ("grey", grey), ("both", grey)):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "0.png", picture)
    write_image(tmp_path / "both" / "1.png", rgb)
    enhance_video(tmp_path / "clip", tmp_path / "a", like=tmp_path / "grey")
    assert "grey holds grey photos alone, so" in capsys.readouterr().err
    enhance_video(tmp_path / "clip", tmp_path / "b", like=tmp_path / "both")
    assert "grey photos" not in capsys.readouterr().err


def test_whole_frames_are_measured_graded_like_the_cameras_other_clips(tmp_path, monkeypatch):
    (tmp_path / "photos").mkdir()
    for i in range(4):
        write_image(tmp_path / "photos" / f"{i}.png", place(1, 2 * i))
    pairs, made_of = PairSet(make_photo_pairs([tmp_path / "photos"], tmp_path / "pairs", width=160)), []
    monkeypatch.setattr(sys.modules["enhance.evaluate"], "Grade", lambda photos: made_of.append(photos) or Grade(photos))
    rows = {(r.kind, r.method): r for r in evaluate(pairs, Enhancer.load())}
    for others, shard in zip(made_of[-4:], pairs.of("isp_frame"), strict=True):
        own = shard.window(0, 1).target[0].permute(1, 2, 0)
        assert len(others) == 3 and not any(torch.equal(other, own) for other in others)
    graded, identity = (rows["isp_frame", method] for method in (GRADED, "identity"))
    assert np.mean(graded.gain(identity)) > 5 and ("clean", GRADED) in rows and ("isp", GRADED) not in rows


@pytest.mark.parametrize("suffix", [".tif", ".TIFF", ".bmp", ".webp"])
def test_one_photo_of_whatever_kind_is_a_picture_and_no_video(tmp_path, suffix):
    photo = tmp_path / f"a{suffix}"
    Image.new("RGB", (40, 30), (200, 10, 10)).save(photo)
    assert len(Grade.read(photo, 40).ranks) == len(Grade.read(tmp_path, 40).ranks) == 1
    with pytest.raises(ValueError, match="is one picture; put it into a folder"):
        enhance_video(photo, tmp_path / "out.mp4")


def test_photos_that_are_not_there_are_refused_before_anything_is_written(tmp_path):
    (tmp_path / "clip").mkdir()
    (tmp_path / "empty").mkdir()
    Image.new("RGB", (16, 12)).save(tmp_path / "clip" / "0.png")
    for like, why in (("nowhere", "no such photos"), ("empty", "holds no photos")):
        with pytest.raises((ValueError, FileNotFoundError), match=why):
            enhance_video(tmp_path / "clip", tmp_path / "out", like=tmp_path / like)
    with pytest.raises(ValueError, match="clip does"):
        enhance_video(tmp_path / "clip", tmp_path / "out", like=tmp_path)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="no photos"):
        Grade([])


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda p: (p * 255).to(torch.uint8), "photo 1 must be floats in 0..1, got torch.uint8; divide bytes by 255"),
        (lambda p: p * 255, "photo 1 must be floats in 0..1, but its mean is"),
        (lambda p: p.index_fill(0, torch.tensor(3), torch.nan), "photo 1 holds a value that is not finite at row 3, column 0"),
    ],
)
def test_photos_that_are_no_pictures_in_0_to_1_are_refused_by_number(spoil, why):
    first, second = photos(1, 2)
    with pytest.raises(ValueError, match=why):
        Grade([first, spoil(second)])
