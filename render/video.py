"""Image and video files: rgb `[H, W, 3]` float32, 0..1, in and out. PIL and PyAV are loaded when first used."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from shlex import quote

import numpy as np
import torch

from render.matroska import lacking
from render.yuv import BT709, HDR, TO_SDR, from_rgb, to_rgb
from scenes.atomic import atomic_file
from scenes.checks import check_floats, check_tensor

CONTAINERS = (".mp4", ".mkv", ".mov")
TICK = Fraction(1, 90_000)
"""Seconds by which the times of frames that are not evenly apart are counted, as in MPEG's own clock."""


def to_bytes(rgb: torch.Tensor) -> np.ndarray:
    """uint8 `[H, W, 3]` of an image `[H, W, 3]`, clamped to 0..1 and rounded. ValueError of bytes, and of nan."""
    check_tensor("an image", rgb, ("H", "W", 3))
    check_floats("an image", rgb)
    if torch.isnan(rgb.sum()) and (lost := int(rgb.isnan().any(-1).sum())):  # one nan makes the sum so
        raise ValueError(f"an image holds nan in {lost} of its {rgb.shape[0] * rgb.shape[1]} pixels; look for where it was made")
    return (rgb.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def from_bytes(pixels: np.ndarray) -> torch.Tensor:
    """float32 `[H, W, 3]` in 0..1 of uint8 pixels `[H, W, 3]`."""
    return torch.from_numpy(np.array(pixels)).to(torch.float32) / 255


def read_image(path: str | os.PathLike) -> torch.Tensor:
    """An image file as `[H, W, 3]` float32 0..1, turned as its EXIF says. ValueError where it cannot be decoded."""
    from PIL import ImageOps

    from scenes.pictures import opened, rgb_of

    with opened(path, str(path), "fetch or export it again") as image:
        return from_bytes(np.asarray(rgb_of(ImageOps.exif_transpose(image))))


def write_image(path: str | os.PathLike, rgb: torch.Tensor) -> None:
    """Write `[H, W, 3]` as PNG or JPEG, whichever the name ends in; the file appears whole or not at all."""
    from PIL import Image

    with atomic_file(path) as partial:
        # quality is JPEG's; PNG packed hardest takes four times as long for a tenth less
        Image.fromarray(to_bytes(rgb)).save(partial, quality=92, compress_level=1)


class Video:
    """A video file's frames, decoded one at a time: iterate for rgb `[H, W, 3]` float32 0..1, turned as the file says (phones').

    fps: frames a second in the mean; width, height: pixels of the turned frames; pixel_aspect: how much wider than high a pixel is to be
    shown; count, seconds: frames and length as the file claims, None where it does not say; sound: whether it has any; dropped: what of the
    first frame is not read, in words, or ''. Raises ValueError where the file is no video, is of high dynamic range, has no frames, breaks
    off in the middle, or goes on in another size.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        if self.path.is_dir():
            raise ValueError(
                f"{path} is a folder, not a video; of pictures make one first, as by ffmpeg -i {quote(str(path))}/%06d.png clip.mp4"
            )
        if not self.path.is_file():
            raise FileNotFoundError(f"no such video: {path}")
        with self._open() as container:
            if not container.streams.video:
                raise ValueError(f"{path} holds no video stream")
            stream = container.streams.video[0]
            self.fps = float(stream.average_rate or stream.guessed_rate or 25)
            self.count = _shown(stream)
            self.seconds = float(stream.duration * stream.time_base) if stream.duration else None
            self.sound = bool(container.streams.audio)
            aspect = stream.sample_aspect_ratio or Fraction(1)
        if cut := lacking(self.path):
            raise ValueError(f"{path} breaks off {cut} bytes before its end; fetch the file again")
        frames = self._decoded()
        first = next(frames)  # what turns them is said with the frames
        frames.close()
        if (transfer := first.color_trc) in HDR:
            fix = f"ffmpeg -i {quote(str(path))} -vf {TO_SDR} {quote(f'{self.path.stem}_sdr.mp4')} makes one that is read"
            raise ValueError(f"{path} is of high dynamic range ({HDR[transfer]}), which is not read; {fix}")
        self.dropped = _dropped(first)
        lies = _turns(first)[0] % 2 == 1
        self.width, self.height = (first.height, first.width) if lies else (first.width, first.height)
        self.pixel_aspect = 1 / aspect if lies else aspect

    def __iter__(self) -> Iterator[torch.Tensor]:
        for _, rgb in self.timed():
            yield rgb

    def timed(self) -> Iterator[tuple[int, torch.Tensor]]:
        """The frames, each after its time in microseconds since the first: they need not be evenly apart."""
        for _, time_us, rgb in self.picked(lambda _: True):
            yield time_us, rgb

    def picked(self, wanted: Callable[[int], bool], end_us: int | None = None) -> Iterator[tuple[int, int, torch.Tensor]]:
        """Number, time and picture of those frames whose times are `wanted`, before `end_us`; others take a third of the work."""
        began = None
        for i, frame in enumerate(self._decoded()):
            at = i / self.fps if frame.pts is None else float(frame.pts * frame.time_base)
            began = at if began is None else began
            time_us = round((at - began) * 1e6)
            if end_us is not None and time_us >= end_us:
                return
            if not wanted(time_us):
                continue
            quarters, mirrored = _turns(frame)
            stored = to_rgb(frame)
            pixels = np.rot90(stored[:, ::-1] if mirrored else stored, quarters)
            if pixels.shape[:2] != (self.height, self.width):
                sizes = f"{self.width}x{self.height} to {pixels.shape[1]}x{pixels.shape[0]}"
                raise ValueError(f"{self.path} changes its size after frame {i}, from {sizes}; cut it there, or scale it to one size")
            yield i, time_us, from_bytes(pixels)

    def _decoded(self):
        """PyAV's frames, as they are stored."""
        from av.error import FFmpegError

        decoded = 0
        with self._open() as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            try:
                for packet in container.demux(stream):
                    if packet.is_corrupt:  # threaded decoding would pass over it in silence
                        raise ValueError(f"{self.path} breaks off after frame {decoded}; fetch the file again")
                    for frame in packet.decode():
                        if frame.is_corrupt and decoded:  # of a stream that was cut, what comes before its first whole frame is, too
                            fix = "fetch the file again, or encode it anew, which fills in what is lost"
                            raise ValueError(f"{self.path} is damaged in frame {decoded}; {fix}")
                        yield frame
                        decoded += 1
            except FFmpegError as error:
                raise ValueError(f"{self.path} cannot be decoded after frame {decoded}: {error.strerror}; fetch the file again") from error
        if decoded == 0:
            raise ValueError(f"{self.path} has no frames that can be decoded")

    def _open(self):
        import av
        from av.error import FFmpegError

        try:
            return av.open(os.path.abspath(self.path))  # else FFmpeg takes what stands before a colon, as in 12:30.mp4, for a protocol
        except FFmpegError as error:
            raise ValueError(f"{self.path} cannot be decoded as video: {error.strerror}; fetch or export it again") from error


def _shown(stream) -> int | None:
    """How many frames a stream of PyAV's claims, None where it does not say; without those that an edit list hides, as before a cut."""
    index = stream.index_entries if stream.frames else ()  # MP4's is whole, Matroska's has key frames alone
    return sum(not entry.is_discard for entry in index) or stream.frames or None


def _turns(frame) -> tuple[int, bool]:
    """Quarter turns to the left that show a frame of PyAV's upright, and whether left and right are changed before, as of selfies."""
    from av.sidedata.sidedata import Type

    told = frame.side_data.get(Type.DISPLAYMATRIX)
    if told is None:
        return 0, False
    a, b, _, c, d = np.frombuffer(bytes(told), np.int32)[:5].astype(float)
    mirrored = bool(a * d < b * c)
    return round(frame.rotation / 90) + 2 * mirrored, mirrored  # a mirrored frame's rotation is told as if top and bottom were changed


def _dropped(frame) -> str:
    """What 8-bit RGB leaves out of a frame of PyAV's, '' for nothing. A GIF's has an alpha channel even where all of it is opaque."""
    from scenes.pictures import unread

    parts = frame.format.components
    alpha = any(part.is_alpha for part in parts) and bool((frame.to_ndarray(format="rgba")[..., 3] < 255).any())
    return unread(alpha, any(part.bits > 8 for part in parts))


def read_video(path: str | os.PathLike) -> Video:
    """Open a video; see Video."""
    return Video(path)


def check_container(path: Path) -> None:
    """ValueError where no video can have a path's name."""
    if path.suffix.lower() not in CONTAINERS:
        raise ValueError(f"{path} must end in {', '.join(CONTAINERS)} to be written as video")


def odd_warning(path: str | os.PathLike, width: int, height: int) -> list[str]:
    """What to tell of a video whose sides in pixels are not even: a sentence, or none."""
    if width % 2 == height % 2 == 0:
        return []
    size = f"{width + width % 2}x{height + height % 2}"
    return [f"{path} has {size} pixels for {width}x{height}: H.264 needs even sides, so a last row or column is there twice"]


class VideoWriter:
    """Writes H.264 in yuv420p, BT.709, frame by frame; the file appears whole when the block ends, or not at all.

    with VideoWriter("out.mp4", fps=10, width=640, height=360) as video:
        video.write(rgb)

    The same frames make the same bytes. They are evenly apart but for those whose times are told. pixel_aspect: how much wider than high a
    pixel is to be shown. Sizes that are odd gain a repeated last row or column, since 4:2:0 has none. A block that wrote no frame raises
    ValueError.
    """

    def __init__(self, path: str | os.PathLike, fps: float, width: int, height: int, crf: int = 18, pixel_aspect: Fraction = Fraction(1)):
        check_container(Path(path))
        if not fps > 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self.path, self.fps, self.width, self.height, self.crf, self.count = Path(path), fps, width, height, crf, 0
        self.pixel_aspect, self._last = pixel_aspect, -1
        self._stack = ExitStack()

    def __enter__(self) -> VideoWriter:
        import av

        with ExitStack() as stack:
            partial = stack.enter_context(atomic_file(self.path))
            options = {"fflags": "+bitexact"}  # Matroska's would have a number drawn by lot
            options |= {"movflags": "+faststart"} if self.path.suffix.lower() in (".mp4", ".mov") else {}
            self._container = stack.enter_context(av.open(str(partial), "w", options=options))
            rate = Fraction(self.fps).limit_denominator(1_000_000)
            self._stream = self._container.add_stream("libx264", rate=rate, options=_x264() | {"crf": str(self.crf)})
            context = self._stream.codec_context
            context.sample_aspect_ratio = self.pixel_aspect
            context.width, context.height, context.pix_fmt = self.width + self.width % 2, self.height + self.height % 2, "yuv420p"
            context.color_primaries = context.color_trc = context.colorspace = BT709
            context.color_range = 1
            self._stack = stack.pop_all()
        return self

    def write(self, rgb: torch.Tensor, time_us: int | None = None) -> None:
        """Add one frame `[height, width, 3]`. time_us: when it is shown, later than the one before, of all frames or of none."""
        check_tensor("a video frame", rgb, (self.height, self.width, 3))
        pixels = np.pad(to_bytes(rgb), ((0, self.height % 2), (0, self.width % 2), (0, 0)), mode="edge")
        frame = from_rgb(pixels)
        if self.count == 0 and time_us is not None:
            self._stream.codec_context.time_base = TICK
        if time_us is None:
            frame.pts = self.count
        else:
            self._last = max(self._last + 1, round(time_us / 1e6 / TICK))
            frame.pts, frame.time_base = self._last, TICK
        self._container.mux(self._stream.encode(frame))
        self.count += 1

    def __exit__(self, kind, value, trace) -> None:
        if kind is not None:
            self._stack.__exit__(kind, value, trace)  # closes the container and removes the partial file
            return
        with self._stack:
            if self.count == 0:
                raise ValueError(f"no frames came for {self.path}; nothing was written")
            self._container.mux(self._stream.encode(None))


def _x264() -> dict[str, str]:
    """How x264 encodes. With what of it is written for AVX-512 the same frames make other bytes from run to run where the width is no
    multiple of 128 pixels; with that for AVX2, which takes as long, they do not."""
    wide = torch.backends.cpu.get_cpu_capability().startswith("AVX512")
    return {"preset": "veryfast"} | ({"x264-params": "asm=AVX2"} if wide else {})
