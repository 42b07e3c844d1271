"""Rendered frames become better frames: the enhancer's state is passed from frame to frame, never hidden."""

from pathlib import Path

import tyro

from enhance import Enhancer
from enhance.clip import telling
from render import render_clip
from render.clip import frame_rate
from render.progress import progress
from render.video import VideoWriter
from scenes import Databank, load
from scenes.insert import insert
from scenes.placement import parse_placement

DATA = Path(__file__).parent / "data"


def main(
    scene: Path = DATA / "drive002",
    databank: Path = DATA / "databank",
    weights: str = "builtin",
    frames: int = 20,
    width: int = 640,
    height: int = 360,
    output: Path = Path("enhanced.mp4"),
) -> None:
    """Put a car in, render the front camera 2 m left of its path, and enhance every frame with the memory of those before it."""
    drive, bank = load(scene), Databank(databank)
    name = bank.entries()[0].id
    times = drive.frame_times("front_camera")[:frames]
    drive = insert(drive, bank.load(name), parse_placement(f"{name}@9m,3.5m,speed=4m/s"), int(times[0]), int(times[-1])).scene
    clip = render_clip(drive, "front_camera", 2.0, times, width, height, outputs=("rgb", "flow_prev", "instance", "need"))
    enhancer, put_in = Enhancer.load(weights), drive.anew()
    memory, changed = None, 0.0
    with VideoWriter(output, frame_rate(times), width, height) as video:
        for frame in progress(clip, "enhance", len(times)):
            # of the instances only what was put in is told: what was recorded has the light of the street already
            better, memory = enhancer.step(telling(frame, put_in), memory)
            changed += float((better - frame.rgb.clamp(0, 1)).abs().mean()) / len(times)
            video.write(better)
    print(f"wrote {output}; a pixel changed by {255 * changed:.2f} of 255 on average")


if __name__ == "__main__":
    tyro.cli(main)
