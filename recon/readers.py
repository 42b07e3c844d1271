"""Which reader reads a folder: one line a layout."""

from __future__ import annotations

from pathlib import Path

from recon.log import Log


def open_log(path: str | Path) -> Log:
    """The drive in a folder, by the layout of its files; reads no image and no sweep yet.

    Raises FileNotFoundError where there is no such folder and ValueError where its layout is not known or a file is corrupt.
    """
    path = Path(path)
    if not path.is_dir():
        raise FileNotFoundError(f"{path} is not a folder; give the folder of one drive, as pandaset/002")
    if (path / "camera").is_dir():
        from recon.pandaset import read_pandaset

        return read_pandaset(path)
    inside = sorted(p.name for p in path.iterdir() if (p / "camera").is_dir())
    hint = f" Did you mean {path / inside[0]}?" if inside else ""
    raise ValueError(f"{path} is not a known layout of a drive: PandaSet's has a camera/ folder.{hint}")
