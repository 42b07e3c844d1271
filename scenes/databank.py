"""The databank: a folder of assets with an index.

databank/index.json  assets/<class>/<number>/{asset.usdc,asset.json,thumb.png,asset.photos/}

An asset's id is "<class>/<number>", as car/0003. index.json lists every entry; asset.json holds the same entry beside the
asset, and from there an index that was lost is made anew by the next asset that is added.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path, PurePosixPath
from shlex import quote

import torch

from scenes.alone import alone
from scenes.asset import Asset
from scenes.atomic import atomic_file, atomic_folder
from scenes.gaussians import Gaussians
from scenes.names import slug, unknown

FORMAT = "sidestep databank"
VERSION = 1


@dataclass(frozen=True)
class Entry:
    """What the index says of one asset: `size` is length, width, height in metres; paths are relative to the databank."""

    id: str
    label: str
    size: tuple[float, float, float]
    splats: int
    views: int | None
    licence: str
    attribution: str
    source: str
    asset: str
    thumb: str | None


class Databank:
    """A databank folder. It need not exist until something is added."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)

    def entries(self) -> list[Entry]:
        """All entries, by id. FileNotFoundError where there is no databank, NotADirectoryError where there is a file, ValueError where its
        index is corrupt."""
        index = self.path / "index.json"
        if self.path.is_file():
            raise NotADirectoryError(f"{self.path} is a file; --databank names a folder of assets, as sidestep assets extract makes one")
        if not index.is_file():
            makes = f"sidestep assets extract SCENE --databank {quote(str(self.path))}, or assets add, makes one"
            fix = f"{makes}; another is named by --databank"
            raise FileNotFoundError(f"{self.path} is not a databank: it has no index.json; {fix}")
        try:
            data = json.loads(index.read_text(encoding="utf-8"))
            if data["format"] != FORMAT or data["version"] != VERSION:
                raise ValueError(f"format {data['format']!r} version {data['version']}, not {FORMAT!r} version {VERSION}")
            entries = [_entry(record) for record in data["entries"]]
        except (ValueError, KeyError, TypeError) as error:
            fix = "delete it, and the next asset that is added rebuilds it from the assets' own entries"
            raise ValueError(f"{index} is corrupt: {type(error).__name__} {error}; {fix}") from error
        return sorted(entries, key=lambda e: e.id)

    def entry(self, id: str) -> Entry:
        """The entry of an id; ValueError naming the nearest where there is none."""
        entries = {e.id: e for e in self.entries()}
        if id not in entries:
            raise ValueError(unknown("asset", id, str(self.path), entries))
        return entries[id]

    def load(self, id: str, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Asset:
        """The asset of an id, with the id in its meta. FileNotFoundError naming the file where one is missing."""
        from scenes.usd.splats import load_asset

        entry = self.entry(id)
        file = self.path / entry.asset
        if not file.is_file():
            raise FileNotFoundError(f"asset {id} of {self.path} lacks its file {file}; restore it, or remove the entry from index.json")
        asset = load_asset(file, clean)
        return replace(asset, meta={**asset.meta, "id": id})

    def add(self, asset: Asset, thumb_png: bytes | None = None, half: bool = False) -> str:
        """Store an asset under the next free number of its class and return the id. It appears whole or not at all.

        Of `asset.meta`, licence, attribution, source and views go into the index. Raises as `ready` does.
        """
        asset.gaussians.validate(f"asset {asset.label!r}")
        self.ready()  # before a folder is made
        with self._held():
            return self._added(asset, thumb_png, half)

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Hold the databank's folder, which is made where there is none, and taken away again where nothing came into it."""
        made = False
        while True:
            made |= not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
            with alone(self.path):
                if not self.path.is_dir():
                    continue  # who made it, and held it, failed
                try:
                    yield
                finally:
                    if made:
                        with suppress(OSError):
                            self.path.rmdir()
                return

    def _added(self, asset: Asset, thumb_png: bytes | None, half: bool) -> str:
        from scenes.usd.splats import save_asset, to_json

        entries = self.ready()
        kind = slug(asset.label)
        folder = self.path / "assets" / kind
        names = [e.id for e in entries] + [f"{kind}/{p.name}" for p in folder.glob("*")]  # a killed add leaves a folder without an entry
        numbers = [int(m[1]) for name in names if (m := re.fullmatch(rf"{kind}/(\d+)", name))]
        id = f"{kind}/{max(numbers, default=0) + 1:04d}"
        home, meta = PurePosixPath("assets", id), asset.meta
        views = meta.get("views")
        entry = Entry(
            id=id,
            label=asset.label,
            size=_metres(asset.size.tolist()),
            splats=len(asset.gaussians),
            views=None if views is None else int(views),
            licence=str(meta.get("licence", "")),
            attribution=str(meta.get("attribution", "")),
            source=str(meta.get("source", "")),
            asset=str(home / "asset.usdc"),
            thumb=None if thumb_png is None else str(home / "thumb.png"),
        )
        told = to_json({**asdict(entry), "meta": meta}, "the asset's meta")
        new = [f for f in (folder, folder.parent) if not f.exists()]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with atomic_folder(self.path / home) as partial:
                save_asset(partial / "asset.usdc", asset, half)
                (partial / "asset.json").write_text(told, encoding="utf-8")
                if thumb_png is not None:
                    (partial / "thumb.png").write_bytes(thumb_png)
            index = {"format": FORMAT, "version": VERSION, "entries": [asdict(e) for e in [*entries, entry]]}
            try:
                with atomic_file(self.path / "index.json") as partial:
                    partial.write_text(json.dumps(index, indent=1, ensure_ascii=False), encoding="utf-8")
            except OSError:
                shutil.rmtree(self.path / home, ignore_errors=True)  # no index tells of it
                raise
        except BaseException:
            for empty in new:
                with suppress(OSError):
                    empty.rmdir()
            raise
        return id

    def original(self, asset: Asset) -> Asset | None:
        """The asset that one in a scene was made from, by its id, label and size; None where this databank has none, or is none."""
        if not (self.path / "index.json").is_file():
            return None
        same = (e.id for e in self.entries() if (e.id, e.label) == (asset.meta.get("id"), asset.label))
        found = next((self.load(id) for id in same), None)
        return found if found is not None and torch.allclose(found.size, asset.size, atol=1e-3) else None

    def same(self, asset: Asset) -> str | None:
        """The id of an asset of the same label, source and splats, None where there is none: that which was cut out of a scene before."""
        told = asset.label, str(asset.meta.get("source", "")), len(asset.gaussians)
        alike = (e.id for e in self.ready() if (e.label, e.source, e.splats) == told)
        return next((id for id in alike if torch.equal(self.load(id).gaussians.means, asset.gaussians.means)), None)

    def ready(self) -> list[Entry]:
        """The entries that a further one will stand beside: those that assets hold themselves, of a databank whose index was lost; none
        where there is no databank. Call it before work whose result is to be added.

        ValueError where a file has its name, where the index is corrupt, or is lost and an asset's own entry is corrupt; PermissionError
        where it is not writable.
        """
        if (file := next((f for f in (self.path, *self.path.parents) if f.is_file()), None)) is not None:
            fix = "give another name with --databank"
            raise ValueError(f"{file} is a file; a databank is a folder, and made where there is none: {fix}")
        there = next(folder for folder in (self.path, *self.path.absolute().parents) if folder.is_dir())
        if not os.access(there, os.W_OK | os.X_OK):
            raise PermissionError(f"{there} is not writable; give another databank with --databank")
        if (self.path / "index.json").exists():
            return self.entries()
        return [read_entry(file) for file in sorted(self.path.glob("assets/*/*/asset.json"))]


def read_entry(file: Path) -> Entry:
    """The entry in an asset.json. FileNotFoundError, or ValueError where it is corrupt."""
    try:
        return _entry(json.loads(file.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is corrupt: {type(error).__name__} {error}; restore it, or take its folder away") from error


def _metres(size: Sequence[float]) -> tuple[float, float, float]:
    length, width, height = (float(v) for v in size)
    return length, width, height


def _entry(record: dict) -> Entry:
    entry = Entry(**{f.name: record[f.name] for f in fields(Entry)})
    for path in filter(None, (entry.asset, entry.thumb)):
        if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts:
            raise ValueError(f"{entry.id} has the path {path}, which leaves the databank")
    return replace(entry, size=_metres(entry.size))
