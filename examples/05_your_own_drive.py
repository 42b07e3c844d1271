"""A drive of your own, in any layout that Sidestep reads: look at it, reconstruct it, and render it from beside its path."""

from pathlib import Path

import tyro

from recon import FitConfig, open_log, reconstruct
from render import render_frame
from render.contact import write_contact_sheet
from render.video import from_bytes


def main(
    data: Path,
    output: Path = Path("scene"),
    camera_height: float | None = None,
    shift: float = 1.0,
    steps: int = 1000,
    width: int | None = None,
) -> None:
    """Reconstruct the log in `data` as the scene `output`, and write `output`.png: recorded, rendered, and `shift` metres to the left.

    camera_height: metres of the cameras above the ground, for COLMAP folders, photos and videos; without it these have no metres.
    """
    log = open_log(data, camera_height=camera_height)
    seconds = (int(log.ego.times_us[-1]) - int(log.ego.times_us[0])) / 1e6
    print(f"{log.name}: {seconds:.1f} s, {len(log.sweeps)} lidar sweeps, {sum(t.moving for t in log.tracks)} movers, {log.meta['body']}")
    for name, camera in log.cameras.items():
        print(f"  {name}: {len(camera)} pictures of {camera.width}x{camera.height}, {camera.lens.kind} lens")

    name = (log.front or tuple(log.cameras))[0]
    recorded = log.camera(name)
    size = (width, round(width * recorded.height / recorded.width)) if width else None
    scene = reconstruct(log, output, cameras=[name], size=size, config=FitConfig(steps=steps))

    metric = log.meta.get("metric", True)
    rows = []
    for time in scene.frame_times(name)[:: max(1, len(recorded) // 3)][:3].tolist():
        view = scene.camera(name, time)
        index = recorded.times_us.tolist().index(time)
        pictures = [from_bytes(recorded.image(index, view.width, view.height)), render_frame(scene, view).rgb]
        if metric:
            pictures.append(render_frame(scene, scene.camera(name, time, ego=scene.ego.shifted(lateral=shift))).rgb)
        rows.append((f"{(time - int(log.ego.times_us[0])) / 1e6:.1f} s", pictures))
    columns = ["recorded", "rendered", *([f"{shift:g} m to the left"] if metric else [])]
    write_contact_sheet(output.with_suffix(".png"), columns, rows)
    print(f"wrote {output} and {output.with_suffix('.png')}" + ("" if metric else "; give --camera-height to shift it"))


if __name__ == "__main__":
    tyro.cli(main)
