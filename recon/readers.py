"""Which reader reads a folder: one line a layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from recon.log import Log


def open_log(path: str | Path, camera_height: float | None = None, metres_per_unit: float | None = None) -> Log:
    """The drive in a folder, by the layout of its files; reads no image and no sweep yet.

    camera_height, metres_per_unit: what makes a world that pictures alone made metric: metres of the cameras above the ground, or
    metres a unit of the model. Raises FileNotFoundError where there is no such folder and ValueError where its layout is not known,
    a file is corrupt, or metres are given to a log that has its own.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path} is not a folder; give the folder of one drive, as pandaset/002")
    read = metric_reader(path)
    if read is not None:
        _without_metres(path, camera_height, metres_per_unit)
        return read(path)
    from recon.colmap import find_model, read_colmap

    if find_model(path) is not None:
        return read_colmap(path, camera_height, metres_per_unit)
    inside = sorted(p for level in ("*", "*/*") for p in path.glob(level) if p.is_dir() and metric_reader(p))
    hint = f" Did you mean {inside[0]}?" if inside else ""
    raise ValueError(f"{path} is not a known layout of a drive: {LAYOUTS}.{hint}")


LAYOUTS = (
    "PandaSet's has camera/, KITTI's raw one oxts/ and image_02/, KITTI's odometry calib.txt and times.txt, "
    "COLMAP's cameras.bin and images.bin"
)


def metric_reader(path: Path) -> Callable[[Path], Log] | None:
    """What reads a folder with metres of its own; None where it is another layout."""
    from recon import kitti

    if (path / "camera").is_dir():
        from recon.pandaset import read_pandaset

        return read_pandaset
    if kitti.is_kitti_raw(path):
        return kitti.read_kitti_raw
    if kitti.is_kitti_odometry(path):
        return kitti.read_kitti_odometry
    return None


def _without_metres(path: Path, camera_height: float | None, metres_per_unit: float | None) -> None:
    given = "--camera-height" if camera_height is not None else "--metres-per-unit" if metres_per_unit is not None else ""
    if given:
        raise ValueError(f"{path} is in metres already; leave out {given}, which is for COLMAP folders, photos and videos")
