"""An OBJ mesh as trimesh reads it, but with all that its materials name: without a word trimesh leaves out what it does not find, and all
files of materials but the first."""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path

from recon.assets.beside import beside

_NUMBERS = r"(?:\s+[-+]?[\d.]+(?:e[-+]?\d+)?(?=\s))+"
_OPTIONS = re.compile(rf"(?:-[a-z]+(?:{_NUMBERS}|\s+\w+)\s+)*", re.I)
"""What stands before the name of a picture, as `-s 1 1 1 -clamp on `."""
_MOVES = re.compile(rf"-([ost])({_NUMBERS})")
"""Those of them that move, repeat or bend it where their numbers are others than 0, 1 and 0."""


def load_obj(path: Path):
    """trimesh's scene, or mesh, of an .obj file. Raises whatever trimesh makes it raise, and ValueError for materials or a picture that is
    not there, and for a picture that is moved or repeated, which trimesh does not do."""
    import trimesh

    folder, body = path.absolute().parent, path.read_bytes()
    files: dict[str, BytesIO] = {}
    names = re.findall(r"^[ \t]*mtllib[ \t]+(\S.*?)\s*$", trimesh.util.decode_text(body), re.M)
    if names:
        files["materials"] = BytesIO("\n".join(_materials(folder, name, files) for name in names).encode())
        body = b"mtllib materials\n" + body
    return trimesh.load(BytesIO(body), file_type="obj", resolver=trimesh.resolvers.ZipResolver(files), process=False)


def _materials(folder: Path, name: str, files: dict[str, BytesIO]) -> str:
    """The text of a file of materials, with its pictures put among the files, and called as they are there."""
    import trimesh

    file = _named(folder, folder, name)

    def put(line: re.Match[str]) -> str:
        before, said = line.groups()
        picture = _named(folder, file.parent, _OPTIONS.sub("", said, count=1).strip('"'))
        for kind, numbers in _MOVES.findall(said):
            if any(float(n) != (kind == "s") for n in numbers.split()):
                raise ValueError(f"{file.name} moves or repeats {picture.name} by -{kind}{numbers}, which is not read; export it without")
        files[str(picture)] = BytesIO(picture.read_bytes())
        return f"{before}{picture}"

    return re.sub(r"^([ \t]*map_Kd[ \t]+)(\S.*?)\s*$", put, trimesh.util.decode_text(file.read_bytes()), flags=re.M | re.I)


def _named(folder: Path, start: Path, name: str) -> Path:
    """What a file in the folder `start`, which is or lies in the mesh's, names. Of a path on another machine the last part is looked for
    beside the mesh, as trimesh does."""
    plain = name.replace("\\", "/")
    return beside(folder, name, str(start / plain), plain, plain.split("/")[-1])
