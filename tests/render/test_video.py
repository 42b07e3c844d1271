import os
import struct

import av
import numpy as np
import pytest
import torch
from PIL import Image

from render.clip import render_clip
from render.compare import psnr
from render.video import VideoWriter, read_image, read_video, write_image
from render.yuv import from_rgb
from scenes.pictures import rgb_of


def smooth_image(height, width):
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    return torch.stack([x, y, 0.5 + 0.5 * torch.sin(3 * x + 2 * y)], -1)


def test_a_png_comes_back_to_the_nearest_byte(tmp_path):
    image = smooth_image(9, 7)
    write_image(tmp_path / "a.png", image)
    assert (read_image(tmp_path / "a.png") - image).abs().max() <= 0.5 / 255 + 1e-6


def test_values_outside_the_display_are_clamped(tmp_path):
    write_image(tmp_path / "a.png", torch.tensor([[[-1.0, 0.5, 7.0]]]))
    assert read_image(tmp_path / "a.png").flatten().tolist() == pytest.approx([0, 128 / 255, 1])


def test_a_video_comes_back_alike(tmp_path):
    image = smooth_image(48, 64)
    with VideoWriter(tmp_path / "a.mp4", 12.5, 64, 48) as video:
        for _ in range(4):
            video.write(image)
    back = read_video(tmp_path / "a.mp4")
    assert (back.width, back.height, back.fps, back.count) == (64, 48, 12.5, 4)
    frames = list(back)
    assert len(frames) == 4
    assert all(psnr(frame, image) > 32 for frame in frames)  # so small an image loses most to 4:2:0


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((0, 1, -1, 0), lambda image: image.rot90(-1)),
        ((0, -1, 1, 0), lambda image: image.rot90(1)),
        ((-1, 0, 0, -1), lambda image: image.rot90(2)),
        ((-1, 0, 0, 1), lambda image: image.flip(1)),  # mirrored, as selfies
        ((1, 0, 0, -1), lambda image: image.flip(0)),
        ((0, 1, 1, 0), lambda image: image.transpose(0, 1)),
        ((0, -1, -1, 0), lambda image: image.transpose(0, 1).rot90(2)),
    ],
)
def test_a_video_that_was_filmed_upright_is_read_upright(tmp_path, matrix, shown):
    """As phones write it: frames as the sensor lies, and how to turn and mirror them in the track's header."""
    image = smooth_image(48, 64)
    with VideoWriter(tmp_path / "a.mp4", 10, 64, 48) as video:
        video.write(image)
    stored = bytearray((tmp_path / "a.mp4").read_bytes())
    header = stored.find(b"tkhd") + 44
    a, b, c, d = (65536 * v for v in matrix)
    stored[header : header + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    (tmp_path / "a.mp4").write_bytes(stored)
    back = read_video(tmp_path / "a.mp4")
    (frame,) = back
    upright = shown(image)
    assert frame.shape == (back.height, back.width, 3) == upright.shape and psnr(frame, upright) > 32


def test_sixteen_bits_of_grey_are_shown_as_eight(tmp_path):
    grey = np.linspace(0, 65535, 256).round().astype(np.uint16).reshape(16, 16)
    Image.fromarray(grey).save(tmp_path / "a.png")
    assert (read_image(tmp_path / "a.png")[..., 1] * 255).flatten().tolist() == pytest.approx(range(256), abs=0.01)


def test_floats_are_refused_and_not_shown_as_black(tmp_path):
    Image.fromarray(np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4)).save(tmp_path / "a.tif")
    with pytest.raises(ValueError, match="a.tif .*its values are floats, of which nothing says what is white: store it with 8 or 16 bits"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("picture", [np.int32, ">u2"], ids=["I", "I;16B"])
def test_other_orders_of_bytes_are_sixteen_bits_too(picture):
    grey = np.array([[0, 257, 32896, 65535]])
    swapped = Image.frombytes("I;16B", (4, 1), grey.astype(">u2").tobytes())
    image = Image.fromarray(grey.astype(np.int32)) if picture is np.int32 else swapped
    assert np.asarray(rgb_of(image))[0, :, 0].tolist() == [0, 1, 128, 255]


@pytest.mark.parametrize("colour", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.5, 0.5, 0.5), (0.2, 0.5, 0.8), (0.9, 0.1, 0.1)])
def test_colours_survive_the_codec(tmp_path, colour):
    with VideoWriter(tmp_path / "a.mp4", 10, 32, 32) as video:
        video.write(torch.tensor(colour).expand(32, 32, 3))
    (frame,) = read_video(tmp_path / "a.mp4")
    assert frame[16, 16].tolist() == pytest.approx(colour, abs=2 / 255)


def test_a_picture_comes_back_as_bright_as_it_was(tmp_path):
    """swscale's fast paths cut off, so that a picture would be a level darker after each pass."""
    image = smooth_image(360, 640)
    with VideoWriter(tmp_path / "a.mp4", 10, 640, 360, crf=1) as video:
        video.write(image)
    (frame,) = read_video(tmp_path / "a.mp4")
    assert (255 * (frame - image).mean((0, 1))).abs().max() < 0.3


BARS = np.repeat(np.array([[200, 30, 30], [30, 160, 40], [30, 40, 190], [200, 150, 120]], np.uint8), 320, 0)[None]


def write_tagged(path, height, tags):
    """Bars of colour in BT.709's YUV, 1280 wide, with these code points of H.273 for transfer, primaries and matrix."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 1280, height, "yuv420p"
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace = tags
        container.mux([*stream.encode(from_rgb(BARS.repeat(height, 0))), *stream.encode(None)])


@pytest.mark.parametrize("tags", [(1, 1, 1), (2, 2, 2)], ids=["told", "untold"])
def test_high_definition_is_bt709_told_or_not(tmp_path, tags):
    write_tagged(tmp_path / "a.mp4", 720, tags)
    (frame,) = read_video(tmp_path / "a.mp4")
    assert (255 * frame[360, 160::320] - torch.from_numpy(BARS[0, 160::320])).abs().max() <= 2


def test_rgb_is_read_as_it_is_stored(tmp_path):
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 1280, 720, "bgr0"
        container.mux([*stream.encode(av.VideoFrame.from_ndarray(BARS.repeat(720, 0), format="rgb24")), *stream.encode(None)])
    (frame,) = read_video(tmp_path / "a.mkv")
    assert torch.equal((255 * frame[0]).round(), torch.from_numpy(BARS[0]).float())


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_high_dynamic_range_is_refused_with_what_makes_it_readable(tmp_path, transfer, name):
    write_tagged(tmp_path / "a.mp4", 48, (transfer, 9, 9))
    with pytest.raises(
        ValueError, match=rf"a.mp4 is of high dynamic range \({name}\).*; ffmpeg -i .*a.mp4 -vf zscale=.*tonemap.* a_sdr.mp4"
    ):
        read_video(tmp_path / "a.mp4")


@pytest.mark.parametrize("name", ["12:30.mp4", "file:a.mkv", "-o.mp4", "50%03d.mov"])
def test_a_name_is_a_name_whatever_is_in_it(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with VideoWriter(name, 10, 16, 16) as video:
        video.write(torch.zeros(16, 16, 3))
    assert [p.name for p in tmp_path.iterdir()] == [name] and len(list(read_video(name))) == 1


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_the_same_frames_make_the_same_bytes(tmp_path, street, suffix):
    """At a width that x264's AVX-512 reads beyond: of twelve MP4s there were three kinds (on a CPU that has it)."""
    frames = [frame.rgb for frame in render_clip(street, "front_camera", width=160, height=90)]
    made = set()
    for _ in range(24):
        with VideoWriter(tmp_path / f"v{suffix}", 10, 160, 90) as video:
            for frame in frames:
                video.write(frame)
        made.add((tmp_path / f"v{suffix}").read_bytes())
    assert len(made) == 1


def test_odd_sizes_gain_a_row_and_a_column(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", 10, 33, 31) as video:
        video.write(smooth_image(31, 33))
    (frame,) = read_video(tmp_path / "a.mp4")
    assert frame.shape == (32, 34, 3)


def test_a_broken_write_leaves_what_was_there(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"precious")
    with pytest.raises(RuntimeError), VideoWriter(tmp_path / "a.mp4", 10, 32, 32) as video:
        video.write(torch.zeros(32, 32, 3))
        raise RuntimeError
    assert (tmp_path / "a.mp4").read_bytes() == b"precious"
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_a_video_without_frames_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="no frames"), VideoWriter(tmp_path / "a.mp4", 10, 32, 32):
        pass
    assert os.listdir(tmp_path) == []


def test_a_frame_of_another_size_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\(32, 32, 3\), got \(16, 32, 3\)"), VideoWriter(tmp_path / "a.mp4", 10, 32, 32) as video:
        video.write(torch.zeros(16, 32, 3))


def test_a_video_that_the_disk_has_no_room_for_is_named_and_leaves_nothing(tmp_path):
    resource = pytest.importorskip("resource", reason="no limits of files here")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(OSError, match="too large") as told, VideoWriter(tmp_path / "a.mp4", 10, 640, 360) as video:
            for seed in range(30):
                video.write(torch.rand(360, 640, 3, generator=torch.Generator().manual_seed(seed)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert told.value.filename == str(tmp_path / "a.mp4") and not list(tmp_path.iterdir())


def test_a_name_that_is_no_video_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.mp4"):
        VideoWriter(tmp_path / "a.gif", 10, 32, 32)


def test_a_file_that_is_no_video_is_named(tmp_path):
    (tmp_path / "clip.mp4").write_text("this is not a video")
    with pytest.raises(ValueError, match=r"clip\.mp4 cannot be decoded"):
        read_video(tmp_path / "clip.mp4")


def test_a_truncated_video_is_named(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", 10, 64, 48) as video:
        for seed in range(8):
            video.write(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(seed)))
    whole = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut\.mp4"):
        list(read_video(tmp_path / "cut.mp4"))


@pytest.mark.parametrize("left", [0.5, 0.999])
def test_a_truncated_matroska_file_is_named(tmp_path, left):
    """FFmpeg says nothing of it, and gives the frames that are there."""
    with VideoWriter(tmp_path / "a.mkv", 10, 64, 48) as video:
        for seed in range(8):
            video.write(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(seed)))
    whole = (tmp_path / "a.mkv").read_bytes()
    assert len(list(read_video(tmp_path / "a.mkv"))) == 8
    (tmp_path / "cut.mkv").write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(ValueError, match=r"cut\.mkv breaks off \d+ bytes before its end; fetch the file again"):
        read_video(tmp_path / "cut.mkv")
    unknown = bytearray(whole)  # as a stream is written, whose length nobody knows yet
    size = whole.index(bytes.fromhex("18538067")) + 4
    unknown[size : size + 8] = b"\x01" + b"\xff" * 7
    (tmp_path / "live.mkv").write_bytes(unknown)
    assert len(list(read_video(tmp_path / "live.mkv"))) == 8


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="gone"):
        read_video(tmp_path / "gone.mp4")
    with pytest.raises(FileNotFoundError, match="gone"):
        read_image(tmp_path / "gone.png")


def test_a_file_that_is_no_image_is_named(tmp_path):
    (tmp_path / "a.png").write_text("not a picture")
    with pytest.raises(ValueError, match=r"a\.png does not decode"):
        read_image(tmp_path / "a.png")


def test_bytes_and_nan_are_refused_and_not_written_as_white_or_black(tmp_path):
    with pytest.raises(ValueError, match="got torch.uint8; divide bytes by 255"):
        write_image(tmp_path / "a.png", torch.full((4, 4, 3), 128, dtype=torch.uint8))
    with pytest.raises(ValueError, match="nan in 1 of its 16 pixels"):
        write_image(tmp_path / "a.png", torch.zeros(4, 4, 3).index_put((torch.tensor(1), torch.tensor(2)), torch.tensor(torch.nan)))
    assert not list(tmp_path.iterdir())


def test_a_damaged_frame_is_named(tmp_path):
    """FFmpeg conceals it with what was before, and says so of the frame alone."""
    with VideoWriter(tmp_path / "a.mkv", 10, 64, 48) as video:
        for seed in range(8):
            video.write(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(seed)))
    with av.open(tmp_path / "a.mkv") as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    whole = (tmp_path / "a.mkv").read_bytes()
    begins = whole.index(packets[4]) + len(packets[4]) // 3
    hurt = bytes(255 - byte for byte in whole[begins : begins + 40])
    (tmp_path / "hurt.mkv").write_bytes(whole[:begins] + hurt + whole[begins + 40 :])
    with pytest.raises(ValueError, match=r"hurt\.mkv is damaged in frame \d; fetch the file again, or encode it anew"):
        list(read_video(tmp_path / "hurt.mkv"))
