"""A recorded drive seen from where the car never was: right of its path, on it, left of it."""

from pathlib import Path

import tyro

from render import render_frame
from render.contact import write_contact_sheet
from scenes import load

DRIVE = Path(__file__).parent / "data" / "drive002"


def main(
    scene: Path = DRIVE,
    camera: str = "front_camera",
    shift: float = 2.0,
    width: int = 640,
    output: Path = Path("shifted.png"),
) -> None:
    """Render a camera at three moments, `shift` metres to the right, on the path, and to the left."""
    drive = load(scene)
    times = drive.frame_times(camera)
    paths = {f"{s:+g} m": drive.ego.shifted(lateral=s) for s in (-shift, 0.0, shift)}

    rows = []
    for time in times[:: max(1, len(times) // 3)][:3]:
        pictures = []
        for path in paths.values():
            view = drive.camera(camera, time, ego=path)
            view = view.resized(width, round(width * view.height / view.width))
            pictures.append(render_frame(drive, view).rgb)
        rows.append((f"{(int(time) - int(times[0])) / 1e6:.1f} s", pictures))
    write_contact_sheet(output, list(paths), rows)
    print(f"wrote {output}")


if __name__ == "__main__":
    tyro.cli(main)
