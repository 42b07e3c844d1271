"""The files that a mesh file names, as its textures: where they lie beside it."""

from __future__ import annotations

from pathlib import Path


def beside(folder: Path, name: str, *others: str) -> Path:
    """The file that a mesh file in a folder names, or else the first that there is of the others. ValueError where none is there, or in a
    folder there, which trimesh shows as white."""
    for each in (name, *others):
        if (file := folder / each).is_file() and file.resolve().is_relative_to(folder.resolve()):
            return file
    raise ValueError(f"{name}, which it names, is not beside it or in a folder there")
