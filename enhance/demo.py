"""`sidestep demo`: the whole main job on the bundled piece of a real drive, and a contact sheet of what it did."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.atomic import atomic_folder
from scenes.opening import fresh, open_scene
from scenes.options import Output, Overwrite
from scenes.placement import parse_placement
from scenes.warnings import warn

if TYPE_CHECKING:
    import torch

    from render.frame_types import Frame
    from scenes import Scene

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
CAMERA = "front_camera"
SHIFT = 2.0
WIDTH, HEIGHT = 640, 360
PARKED = "car/0001@32m,6.1m"
MOVING = "car/0003@6.5m,0m,speed=2.8m/s"
# the recording itself is not ours to bundle: the first column is the reconstruction seen from the recorded path
COLUMNS = ("recorded view, reconstructed", "shifted 2 m to the left", "with a parked and a moving asset", "enhanced")


@dataclass
class Demo:
    """Run the whole main job on a bundled real street: shifted 2 m left, a parked and a moving asset, enhanced."""

    output: Output = Path("demo")
    """Folder for out.mp4, out.json and contact.png."""
    overwrite: Overwrite = False
    """Replace what an earlier demo wrote."""

    def run(self) -> None:
        import time

        start = time.monotonic()
        if not DATA.is_dir():
            raise FileNotFoundError(f"the demo's drive is not at {DATA}: it comes with the source; clone that and run make demo there")
        if self.output.exists() and not self.output.is_dir():
            raise FileExistsError(f"{self.output} is a file, and the demo makes a folder; give it another name with -o")
        files = [self.output / name for name in ("out.mp4", "out.json", "contact.png")]
        if self.output.exists():
            for file in files:
                fresh(file, self.overwrite)
            demonstrate(DATA, self.output)
        else:
            with atomic_folder(self.output) as whole:
                demonstrate(DATA, whole)
        print(f"made {', '.join(map(str, files[:-1]))} and {files[-1]} in {time.monotonic() - start:.0f} s")


def demonstrate(data: Path, folder: Path, weights: str = "builtin") -> None:
    """Shoot the clip from the scene and databank in `data`, and draw the contact sheet."""
    from enhance.clip import enhancement
    from render.contact import write_contact_sheet
    from render.record import record
    from scenes import Databank
    from scenes.insert import insert

    bare, _ = open_scene(data / "drive002")
    times = bare.frame_times(CAMERA)
    scene = bare
    for text in (PARKED, MOVING):
        placement = parse_placement(text)
        result = insert(scene, Databank(data / "databank").load(placement.asset), placement, int(times[0]))
        scene = result.scene
        warn(result.warnings)

    shown = _rows(len(times))
    before: dict[int, torch.Tensor] = {}
    after: dict[int, torch.Tensor] = {}
    stages, needs = enhancement(weights, scene=scene)
    enhance = stages["enhance"]

    def noted(frames: Iterator[Frame]) -> Iterator[Frame]:
        return _noting(enhance(_noting(frames, shown, before)), shown, after)

    facts = {"scene": str(data / "drive002"), "enhanced": weights}
    stages = {**stages, "enhance": noted}
    record(
        scene, CAMERA, folder / "out.mp4", shift=SHIFT, times_us=times, width=WIDTH, height=HEIGHT,
        stages=stages, needs=needs, facts=facts,
    )  # fmt: skip

    rows = []
    for i in shown:
        t = int(times[i])
        name = f"{(t - int(times[0])) / 1e6:.1f} s"
        rows.append((name, [_view(bare, t, 0.0), _view(bare, t, SHIFT), before[i], after[i]]))
    write_contact_sheet(folder / "contact.png", COLUMNS, rows)


def _rows(count: int) -> list[int]:
    """Which frames the sheet shows: near the beginning, in the middle, near the end."""
    return sorted({count // 8, count // 2, count - 1 - count // 8})


def _noting(frames: Iterator[Frame], which: list[int], notes: dict[int, torch.Tensor]) -> Iterator[Frame]:
    """The frames as they are, with the rgb of some put down in `notes`."""
    for i, frame in enumerate(frames):
        if i in which and frame.rgb is not None:
            notes[i] = frame.rgb
        yield frame


def _view(scene: Scene, time_us: int, shift: float) -> torch.Tensor | None:
    from render import render_clip

    (frame,) = render_clip(scene, CAMERA, shift, [time_us], WIDTH, HEIGHT)
    return frame.rgb
