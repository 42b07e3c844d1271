"""Two cars that were never there: one parked, one driving, from the databank onto the recorded street."""

from pathlib import Path

import tyro

from render import render_clip
from render.clip import frame_rate
from render.progress import progress
from render.video import VideoWriter
from scenes import Databank, load
from scenes.insert import insert
from scenes.placement import Placement, parse_placement

DATA = Path(__file__).parent / "data"


def main(
    scene: Path = DATA / "drive002",
    databank: Path = DATA / "databank",
    frames: int = 20,
    width: int = 640,
    height: int = 360,
    output: Path = Path("inserted.mp4"),
) -> None:
    """Insert the databank's first asset twice and film it from 2 m left of the recorded path."""
    drive, bank = load(scene), Databank(databank)
    name = bank.entries()[0].id
    times = drive.frame_times("front_camera")[:frames]
    parked = parse_placement(f"{name}@32m,6.1m")  # as on the command line: metres forward and left of the car
    driving = Placement(name, x=9.0, y=3.5, speed=4.0)  # the same in numbers: metres, radians, metres a second
    for placement in (parked, driving):
        result = insert(drive, bank.load(name), placement, int(times[0]), int(times[-1]))
        drive = result.scene
        for warning in result.warnings:  # of what it would run into while the clip lasts
            print(warning)

    clip = render_clip(drive, "front_camera", shift=2.0, times_us=times, width=width, height=height)
    with VideoWriter(output, frame_rate(times), width, height) as video:
        for frame in progress(clip, "render", len(times)):
            video.write(frame.rgb)
    print(f"wrote {output}")


if __name__ == "__main__":
    tyro.cli(main)
