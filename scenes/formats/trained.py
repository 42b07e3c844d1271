"""How a file says that its splats were trained, which is how they must be drawn."""

from __future__ import annotations

import re
from pathlib import Path

from scenes.formats import COMPRESSED_PLY, PLY, SOG, SPZ, USD, found
from scenes.formats.ply import last_comment
from scenes.gaussians import SplatModel

_COMMENT = re.compile(
    rb"^comment[ \t]+(splatrendermode:[ \t]*mip|antialiased[ \t]+1|splatrendermode:|antialiased[ \t]+0)", re.MULTILINE | re.IGNORECASE
)


def model_of(path: Path) -> SplatModel:
    """The model that a file of splats names, the default one where it names none. The file was read before, and is whole.

    Antialiased: comments of Brush and Postshot in PLY, the last of which counts, a flag of SPZ, and SOG's model; USD: all that Sidestep
    wrote.
    """
    form = found(path)
    if form is USD:
        from scenes.usd.splats import model_in

        return model_in(path)
    if form is SPZ:
        from scenes.formats.spz import antialiased
    elif form is SOG:
        from scenes.formats.sog import antialiased
    elif form in (PLY, COMPRESSED_PLY):
        antialiased = _commented
    else:
        return SplatModel()
    return SplatModel(antialias=antialiased(path))


def _commented(path: Path) -> bool:
    said = last_comment(path, _COMMENT)
    return said is not None and said.lower().endswith((b"mip", b"1"))
