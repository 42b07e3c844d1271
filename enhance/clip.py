"""A video file in, a better one out, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from enhance.enhancer import Enhancer


def enhance_video(
    source: str | Path,
    out: str | Path,
    enhancer: Enhancer | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> int:
    """Enhance any video that FFmpeg decodes, of any size, in constant memory; returns the number of frames.

    The result is H.264 at the source's rate without its sound. A side that is odd gains one repeated row or column, which
    H.264's 4:2:0 needs. `progress` is called with frames done and frames in all, where the file says. Raises FileNotFoundError,
    and ValueError where the source cannot be decoded; nothing is left under `out` then.
    """
    from render.video import VideoWriter, read_video

    video = read_video(source)
    if Path(out).exists() and Path(out).samefile(source):
        raise ValueError(f"{out} is the clip itself; write the enhanced one elsewhere")
    enhancer = enhancer or Enhancer.load()
    memory, done = None, 0
    with VideoWriter(out, video.fps, video.width, video.height) as writer:
        for rgb in video:
            better, memory = enhancer.step(rgb, memory)
            writer.write(better)
            done += 1
            if progress is not None:
                progress(done, video.count)
    return done
