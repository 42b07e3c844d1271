"""Rendered frames become better frames: the enhancer's state is passed from frame to frame, never hidden."""

from pathlib import Path

import tyro

from enhance import Enhancer
from render import render_clip
from render.clip import frame_rate
from render.progress import progress
from render.video import VideoWriter
from scenes import load

DRIVE = Path(__file__).parent / "data" / "drive002"


def main(
    scene: Path = DRIVE,
    weights: str = "builtin",
    frames: int = 20,
    width: int = 640,
    height: int = 360,
    output: Path = Path("enhanced.mp4"),
) -> None:
    """Render the front camera 2 m left of its path and enhance every frame with the memory of those before it."""
    drive = load(scene)
    enhancer = Enhancer.load(weights)
    times = drive.frame_times("front_camera")[:frames]
    clip = render_clip(drive, "front_camera", 2.0, times, width, height, outputs=("rgb", "flow_prev", "instance"))
    memory, changed = None, 0.0
    with VideoWriter(output, frame_rate(times), width, height) as video:
        for frame in progress(clip, "enhance", len(times)):
            better, memory = enhancer.step(frame, memory)
            changed += float((better - frame.rgb.clamp(0, 1)).abs().mean()) / len(times)
            video.write(better)
    print(f"wrote {output}; a pixel changed by {255 * changed:.2f} of 255 on average")


if __name__ == "__main__":
    tyro.cli(main)
