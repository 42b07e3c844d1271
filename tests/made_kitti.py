"""The made-up recording in KITTI's layouts: a raw drive, synced and rectified, and an odometry sequence."""

from pathlib import Path

from made_tape import BODY_FROM_LIDAR, STAMPS, STEP_US, Tape
from PIL import Image

from scenes.poses import inverse
from tests.layouts.kitti import NAMES, projections, text, write, write_scan

__all__ = ["NAMES", "write_kitti_odometry", "write_kitti_raw"]


def write_kitti_raw(folder: Path, tape: Tape) -> Path:
    """A `_sync` drive and the calibration beside it; the third sweep is lost."""
    return write(folder, tape.log({"front": 0, "right": 0}, turn_us=STEP_US), BODY_FROM_LIDAR)


def write_kitti_odometry(folder: Path, tape: Tape) -> Path:
    """Sequence 04 and its poses; the third sweep is lost."""
    sequence = folder / "dataset" / "sequences" / "04"
    (folder / "dataset" / "poses").mkdir(parents=True)
    rect_from_body, made = projections(tape.log({"front": 0, "right": 0}))
    lines = [f"P{int(number)}: {text(p)}" for number, p in made.items()]
    sequence.mkdir(parents=True)
    (sequence / "calib.txt").write_text("\n".join([*lines, f"Tr: {text((rect_from_body @ BODY_FROM_LIDAR)[:3])}"]) + "\n")
    (sequence / "times.txt").write_text("".join(f"{(t - STAMPS[0]) / 1e6:e}\n" for t in STAMPS))
    first = tape.ego.at(int(STAMPS[0])) @ inverse(rect_from_body)
    poses = [(inverse(first) @ tape.ego.at(t) @ inverse(rect_from_body))[:3] for t in STAMPS.tolist()]
    (folder / "dataset" / "poses" / "04.txt").write_text("\n".join(text(p) for p in poses) + "\n")
    for i, t in enumerate(STAMPS.tolist()):
        for name, number in NAMES.items():
            path = sequence / f"image_{int(number)}" / f"{i:06d}.png"
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(tape.image(name, t)).save(path)
        if i != 2:
            write_scan(sequence / "velodyne" / f"{i:06d}.bin", tape.scan(t))
    return sequence
