"""A video file, or a stream of rendered frames, in; a better one out, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import torch

from enhance.correcting.grade import Grade, Graded
from enhance.enhancer import Enhancer
from enhance.object_ids import ObjectIds
from enhance.pictures import Pictures, PictureWriter
from enhance.step import Steps, frame_of
from render.frame_types import Frame
from render.record import Stages
from render.references import READS as NEEDED
from render.references import References
from render.video import Video, VideoWriter, odd_warning, read_video
from scenes.pictures import PICTURES, count_of, opened
from scenes.scene import Scene
from scenes.warnings import warn

GUIDES = ("flow_prev", "instance", "need", "reference")
"""What an enhancer may go by beside the picture."""

HUGE = 50_000_000
"""Weights from which a model is no matter of milliseconds on a CPU."""


def load_saying(weights: str, device: str = "cpu") -> Steps:
    """The enhancer of `Enhancer.load`; a warning where it is far too large for the device to be quick."""
    enhancer = Enhancer.load(weights, device)
    count = enhancer.about.get("weights used", 0)
    if count > HUGE and enhancer.device.type == "cpu":
        name, size = enhancer.about["model"], f"{count / 1e6:.0f} million weights, {count * 4 / 2**30:.1f} GiB in float32"
        warn([f"{name} ({size}) redraws every pixel: seconds to minutes a frame on this CPU; --weights builtin is made for it"])
    return enhancer


def enhance_frames(frames: Iterable[Frame], enhancer: Steps, scene: Scene | None = None) -> Iterator[Frame]:
    """The frames of one clip with their rgb enhanced, each as soon as it comes; best rendered with the outputs in `enhancer.reads`, which
    alone it goes by: what else was rendered to be kept changes no picture. Of the instances it is told those that are `anew` in the
    `scene`, all where None: recorded actors have their own light and shadow already."""
    memory, anew = None, None if scene is None else scene.anew()
    hidden: dict[str, Any] = {name: None for name in GUIDES if name not in enhancer.reads}
    for frame in frames:
        read = replace(frame, **hidden)
        better, memory = enhancer.step(read if anew is None else telling(read, anew), memory)
        yield replace(frame, rgb=better)


def telling(frame: Frame, ids: Sequence[int]) -> Frame:
    """The frame with these of its instances, if it has them at all; the others count as background."""
    if frame.instance is None:
        return frame
    known = torch.isin(frame.instance, torch.tensor(ids, dtype=frame.instance.dtype, device=frame.instance.device))
    return replace(frame, instance=torch.where(known, frame.instance, frame.instance.clamp_max(0)))


def enhancement(
    weights: str, device: str = "cpu", references: References | None = None, scene: Scene | None = None
) -> tuple[Stages, tuple[str, ...]]:
    """What turns a stream of rendered frames into a stream of enhanced ones, in stages, and the outputs that it reads; it warns where
    there is nothing to go by. references: of the scene, if it has photos; scene: which tells what was put in (`enhance_frames`)."""
    enhancer = load_saying(weights, device)
    if isinstance(enhancer, Enhancer) and not any(enhancer.repairs) and references is None and scene is not None and not scene.anew():
        warn(["nothing will be enhanced: the scene keeps no photos, nothing was inserted, and these weights repair nothing else"])
    outputs = tuple(name for name in enhancer.reads if name != "reference")
    stages: dict[str, Callable] = {"enhance": partial(enhance_frames, enhancer=enhancer, scene=scene)}
    if references is None or "reference" not in enhancer.reads:
        return stages, outputs
    return {"references": references.along, **stages}, (*outputs, *NEEDED)


def enhance_video(
    source: str | Path,
    out: str | Path,
    enhancer: Steps | None = None,
    progress: Callable[[int, int | None], None] | None = None,
    rendered: bool = False,
    instances: str | Path | None = None,
    like: str | Path | None = None,
) -> tuple[int, int]:
    """Enhance any video that FFmpeg decodes, or the pictures of a folder, of any size, in constant memory; returns how many frames there
    are, and how many of them were changed.

    A video becomes H.264 with the source's times and shape of pixels, without its sound; a side that is odd gains one repeated row or
    column, which H.264's 4:2:0 needs. A folder becomes a folder of 8-bit RGB PNG by the same names. `progress` is called with frames done
    and frames in all, where the file says. rendered: whether the clip shows renders, which our own network repairs. instances: a folder
    that tells where objects were put in (`ObjectIds`), whose colours and shadows are set right. like: photos of the place, in whose colours
    the whole clip is graded before (`Grade.read`). Without any of them our own network leaves a clip as it is; it warns where no frame was
    changed. Raises FileNotFoundError, and ValueError where the source cannot be decoded; nothing is left under `out` then.
    """
    if Path(source).is_file() and Path(source).suffix.lower() in PICTURES:
        with opened(source, str(source), "fetch or export it again") as picture:
            count = count_of(picture)
        if count > 1:
            fix = f"store each as a file of its own, as by magick {quote(str(source))} -coalesce FOLDER/%06d.png, and give their folder"
            raise ValueError(f"{source} holds {count} pictures, of which only the first would be read; {fix}")
        raise ValueError(f"{source} is one picture; put it into a folder, and give that")
    clip = Pictures(source) if Path(source).is_dir() else read_video(source)
    _check_apart(Path(out), {"the clip itself": source, "the folder of instances": instances, "where the photos are": like})
    ids = None if instances is None else ObjectIds(instances, clip.count)
    enhancer = enhancer or Enhancer.load()
    if ids is not None and "instance" not in enhancer.reads:
        raise ValueError(f"{enhancer.about.get('model', 'this model')} takes no instance masks; leave out --instances")
    if isinstance(enhancer, Enhancer) and not rendered:
        enhancer = enhancer.for_photos()
    if like is not None:
        grade = Grade.read(like, clip.width)
        if grade.grey:
            warn([f"{like} holds grey photos alone, so {out} loses most of its colour; give photos in colour to keep its own"])
        enhancer = Graded(enhancer, grade)
    memory: Any = None
    done, changed, told = 0, 0, False
    with _writer(out, clip) as writer:
        for at, rgb in clip.timed():
            instance = None if ids is None else ids.of(done, clip.width, clip.height)
            told = told or (instance is not None and bool((instance > 0).any()))
            better, memory = enhancer.step(rgb if instance is None else frame_of(rgb, instance), memory)
            changed += not torch.equal(better, rgb.to(better).clamp(0, 1))
            writer.write(better, at)
            done += 1
            if progress is not None:
                progress(done, clip.count)
        if ids is not None:
            ids.check_count(done)  # what a video claims may be wrong, and many claim nothing
    if clip.dropped:
        warn([f"{out} is without what {'pictures of ' * isinstance(clip, Pictures)}{source} had: {clip.dropped}"])
    if isinstance(clip, Video):
        warn(odd_warning(out, clip.width, clip.height))
    if isinstance(clip, Video) and clip.sound:
        fix = f"ffmpeg -i {quote(str(out))} -i {quote(str(source))} -map 0:v -map 1:a -c copy with_sound{Path(out).suffix} puts it back"
        warn([f"{out} is without the sound of {source}; {fix}"])
    if not changed:
        why = f"its colours are those of {like}" if like is not None else _why(rendered, instances, told)
        warn([f"no frame of {source} was changed: {why}; render --enhance knows the inserted objects and the scene's photos"])
    return done, changed


def _check_apart(out: Path, read: dict[str, str | Path | None]) -> None:
    """ValueError where `out`, which is replaced, is one of what is read, by what that is, or the folder of a picture that is read."""
    for what, path in read.items():
        if path is None or not out.exists() or not Path(path).exists():  # what is not there is refused where it is read
            continue
        if out.samefile(path) or (Path(path).suffix.lower() in PICTURES and out.samefile(Path(path).parent)):
            raise ValueError(f"{out} is {what}; write the enhanced one elsewhere")


def _writer(out: str | Path, clip: Pictures | Video) -> PictureWriter | VideoWriter:
    if isinstance(clip, Pictures):
        return PictureWriter(out, [file.stem for file in clip.files])
    return VideoWriter(out, clip.fps, clip.width, clip.height, pixel_aspect=clip.pixel_aspect)


def _why(rendered: bool, instances: str | Path | None, told: bool) -> str:
    if instances is not None and not told:
        return f"{instances} has no object, all of it is 0"
    if instances is not None:
        return "these weights find the masked objects right, or too small to judge"
    if rendered:
        return "the repair network of these weights is switched off, as it gained too little on new places"
    return "give --rendered if it shows renders, --instances where objects were inserted, --like if all of it is in other colours"
