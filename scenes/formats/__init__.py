"""Splat files: one module a format, one registry. Each module has `load_*(path, clean)` and `save_*(path, gaussians)`.

Splats keep the numbers of their file: PLY, compressed PLY, .splat and SOG name no axes that all tools agree on, so nothing is turned.
GLB and SPZ do (both are Y up by their texts), so their splats are turned to this project's Z up on the way in; GLB's node turns them
back, and SPZ, which has none, gets other numbers.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scenes.gaussians import Gaussians


@dataclass(frozen=True)
class Format:
    """A kind of splat file: its name, its suffixes, and the module that reads and writes it.

    ordered: whether it is written along a Morton curve, since its neighbours share a range of values or compress together. tagged:
    whether it has a place for how splats were trained (scenes/formats/trained.py).
    """

    name: str
    suffixes: tuple[str, ...]
    module: str
    functions: str
    ordered: bool = False
    tagged: bool = False

    def load(self, path: Path, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
        """The splats of a file. ValueError where it is not of this format or not whole; `clean` answers for the values."""
        return getattr(importlib.import_module(self.module), f"load_{self.functions}")(path, clean)

    def save(self, path: Path, gaussians: Gaussians, antialias: bool = False) -> None:
        """Write splats, as `arranged` has them, whole or not at all. ValueError where the format cannot hold them."""
        more = {"antialias": antialias} if self.tagged else {}
        getattr(importlib.import_module(self.module), f"save_{self.functions}")(path, self.arranged(gaussians), **more)

    def arranged(self, gaussians: Gaussians) -> Gaussians:
        """The splats in the order in which this format stores them."""
        if not self.ordered:
            return gaussians
        from scenes.formats.packing import morton_order

        return gaussians.select(morton_order(gaussians.means))


PLY = Format("PLY", (".ply",), "scenes.formats.ply", "ply", tagged=True)
COMPRESSED_PLY = Format(
    "compressed PLY", (".compressed.ply",), "scenes.formats.compressed_ply", "compressed_ply", ordered=True, tagged=True
)
USD = Format("USD", (".usdc", ".usda", ".usd"), "scenes.usd.splats", "gaussians")
GLB = Format("GLB", (".glb",), "scenes.formats.glb", "glb")
SPZ = Format("SPZ", (".spz",), "scenes.formats.spz", "spz", tagged=True)
SPLAT = Format(".splat", (".splat",), "scenes.formats.splat", "splat")
SOG = Format("SOG", (".sog",), "scenes.formats.sog", "sog", ordered=True, tagged=True)
FORMATS = (PLY, COMPRESSED_PLY, USD, GLB, SPZ, SPLAT, SOG)
SUFFIXES = tuple(suffix for form in FORMATS for suffix in form.suffixes)


def named(path: Path) -> Format | None:
    """The format that a path's name asks for, None where it is no splat file's."""
    name = path.name.lower()
    fits = [(len(suffix), form) for form in FORMATS for suffix in form.suffixes if name.endswith(suffix)]
    return max(fits, key=lambda fit: fit[0])[1] if fits else None


def found(path: Path) -> Format | None:
    """The format of what stands at a path, None where it holds no splats: its name says, and of the two kinds of PLY its header."""
    if path.name == "meta.json" or (path.is_dir() and (path / "meta.json").is_file()):
        return SOG
    form = named(path) if path.is_file() else None
    if form in (PLY, COMPRESSED_PLY):
        with open(path, "rb") as file:
            head = file.read(1 << 16)
        # a property's line: comments may hold the word
        return COMPRESSED_PLY if re.search(rb"^property[ \t]+\w+[ \t]+packed_position\s", head, re.MULTILINE) else PLY
    return form
