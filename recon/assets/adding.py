"""Assets from outside: a mesh or splats of one's own become an entry of the databank, and entries are checked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote

import torch

from recon.assets.backwards import backwards
from recon.assets.extract import moved, thumbnail
from recon.assets.mesh_files import read_mesh, turn_to_asset
from recon.assets.meshes import MeshFit, asset_of_mesh
from recon.assets.overturned import overturned
from render.progress import Progress
from scenes.asset import Asset
from scenes.databank import Databank
from scenes.files import load
from scenes.formats import GLB, PLY, SPZ, USD, found
from scenes.formats.axis import loaded_axis
from scenes.formats.trained import model_of
from scenes.gaussians import Gaussians
from scenes.opening import scene_folder
from scenes.report import validate
from scenes.scene import Scene
from scenes.sizes import SHEET, odd_size

OUTLIERS = 0.002
"""Part of the opacity of splats, on either side of an axis, that their box leaves out: floaters are not part of a thing."""

THINNEST = 1e-3
"""Metres that every side of an asset's box has, if its splats lie in a plane."""

OFF = 0.12
"""Part of an asset's size by which its splats' box may differ from it before it counts as misplaced."""

BACKWARDS = "has red lamps in front and none behind: it seems to face backwards"
"""What is said of an asset that does."""


def add_mesh(
    databank: Path, file: Path, label: str, scale: float | None, up: str | None, forward: str | None, share: dict, force: bool = False,
    config: MeshFit = MeshFit(),  # noqa: B008 - frozen
) -> tuple[str, str]:  # fmt: skip
    """Store a mesh file as a splat asset; its id, and what a person should know. ValueError where its size is odd and not `force`d, and as
    `Databank.ready` says."""
    bank = Databank(databank)
    bank.ready()
    up, forward = up or "y", forward or "z"
    mesh = read_mesh(file, up, forward, scale or 1.0)
    _check_size(file, label, (mesh.vertices.max(0) - mesh.vertices.min(0)).tolist(), scale or 1.0, (up, forward), force)
    _check_upright(file, label, torch.from_numpy(mesh.vertices), up, force)
    with Progress("fit", total=config.steps) as steps:
        meta = {**share, "source": file.name}
        asset = asset_of_mesh(mesh, label, meta, config, lambda _, loss: steps.step(note=f"loss {loss:.4f}"))
    id = bank.add(asset, thumbnail(asset))
    likeness = f"{asset.meta['psnr_unseen_whole_picture']:.1f} dB (over its own pixels {asset.meta['psnr_unseen']:.1f} dB)"
    return id, f"{_told(asset)}; {likeness} to the traced mesh from unseen views{_facing(asset, forward)}"


def add_splats(
    databank: Path, file: Path, label: str, scale: float | None, up: str | None, forward: str | None, share: dict, force: bool = False
) -> tuple[str, str]:
    """Store a file of splats as an asset: turned, scaled, and set down on the ground; returns and raises as `add_mesh`.

    scale, up, forward: what the file's own axes and unit are where they are not as its format has them (`own_axes`).
    """
    splats = load(file)
    if isinstance(splats, Scene):
        raise ValueError(f"{file} is a scene; sidestep assets extract {quote(str(scene_folder(file)))} cuts out what it has")
    if not isinstance(splats, Gaussians):
        fix = f"make splats of it: sidestep convert {quote(str(file))} {file.stem}.ply, and add these with --up z --forward x"
        raise ValueError(f"{file} is an asset already, with its own frame and size; name its databank by --databank, or {fix}")
    if not len(splats):
        raise ValueError(f"{file} holds no splats")
    own_up, own_forward, metres = own_axes(file)
    up, forward = up or own_up, forward or own_forward
    turn_to_asset(up, forward)  # refuses them by the names that they have in the file
    upright = turned_upright(splats, scale / metres if scale else 1.0, loaded_axis(file, up), loaded_axis(file, forward))
    low, high = solid_box(upright)
    base = torch.tensor([float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2, float(low[2])])
    asset = Asset(
        replace(upright, means=upright.means - base),
        (high - low).double().clamp_min(THINNEST),
        label,
        model_of(file),
        {**share, "source": file.name},
    )
    _check_size(file, label, asset.size.tolist(), scale or metres, (up, forward), force)
    _check_upright(file, label, _solid(asset), up, force)
    return Databank(databank).add(asset, thumbnail(asset)), _told(asset) + _facing(asset, forward)


def own_axes(file: Path) -> tuple[str, str, float]:
    """Of a file of splats the axes up and forward by its format, and the metres of the unit that it names, by which its splats were
    multiplied when they were loaded.

    glTF faces +z with y up, as does a USD stage that says y up; SPZ looks along -z with y up; a stage that says z up faces x, as robots do.
    All others stand as cameras see them: y down, z ahead.
    """
    form = found(file)
    if form in (GLB, SPZ):
        return "y", "z" if form is GLB else "-z", 1.0
    if form is USD:
        from scenes.usd.splats import stage_axes

        said, metres = stage_axes(file)
        up, forward = {"y": ("y", "z"), "z": ("z", "x")}.get(said or "", ("-y", "z"))
        return up, forward, metres
    return "-y", "z", 1.0


def turned_upright(splats: Gaussians, scale: float, up: str, forward: str) -> Gaussians:
    """Splats in the axes of assets: x forward, z up, `scale` metres a unit of theirs."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(turn_to_asset(up, forward))
    grown = replace(splats, means=splats.means * scale, log_scales=splats.log_scales + torch.tensor(scale).log())
    reach = 2 * grown.means.abs().amax() + 1
    return moved(grown, pose, reach.double().expand(3))


def solid_box(splats: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    """Low and high corner `[3]` of all but the outermost `OUTLIERS` of the splats' opacity along each axis."""
    weight = torch.sigmoid(splats.logit_opacities.double())
    low, high = torch.zeros(3), torch.zeros(3)
    for axis in range(3):
        values, order = splats.means[:, axis].sort()
        share = weight[order].cumsum(0) / weight.sum()
        low[axis] = values[int((share < OUTLIERS).sum().clamp_max(len(values) - 1))]
        high[axis] = values[int((share < 1 - OUTLIERS).sum().clamp_max(len(values) - 1))]
    return low, high


def holds_splats(file: Path) -> bool:
    """Whether a file holds splats rather than a mesh: of the kinds that can hold either, the header says."""
    form = found(file)
    mark = {PLY: b"opacity", GLB: b"gaussian_splat"}.get(form) if form else None
    if mark is None:
        return form is not None
    with open(file, "rb") as opened:
        return mark in opened.read(1 << 20)


def check_databank(path: Path) -> list[str]:
    """What is wrong with the entries of a databank, one sentence a problem: files, values, sizes, and where the splats stand."""
    bank, problems = Databank(path), validate(path)
    for entry in bank.entries():
        if odd := odd_size(entry.label, entry.size):
            problems.append(f"{entry.id} {odd}")
        try:
            asset = bank.load(entry.id)
        except (ValueError, OSError):
            continue  # said above
        if misplaced := _misplaced(asset):
            problems.append(f"{entry.id} {misplaced}")
        if backwards(asset):
            problems.append(f"{entry.id} {BACKWARDS}: add it anew with the other --forward, if it does")
    return problems


def _misplaced(asset: Asset) -> str:
    """How the splats of an asset do not stand in its box, or ''."""
    if not len(asset.gaussians):
        return "has no splats"
    low, high = (corner.tolist() for corner in solid_box(asset.gaussians))
    length, width, height = asset.size.tolist()
    slack = OFF * max(length, width, height)
    box = [(-length / 2, length / 2), (-width / 2, width / 2), (0.0, height)]
    # seen from one side only, splats may fill half a box, so they are only held to stay inside, and to fill half of it
    out = max(max(b[0] - lo, hi - b[1]) for lo, hi, b in zip(low, high, box, strict=True))
    if out > slack:
        where = " to ".join("(" + ", ".join(f"{v:.2f}" for v in corner) + ")" for corner in (low, high))
        size = f"{length:.2f} x {width:.2f} x {height:.2f} m"
        return f"has splats at {where} m, {out:.2f} m outside its box of {size}: its origin or axes are wrong"
    filled = [(high[i] - low[i]) / size for i, size in ((0, length), (2, height)) if size > SHEET]
    if min(filled, default=1.0) < 0.5:
        return f"has splats that fill {min(filled):.0%} of its box: its scale or axes are wrong"
    return "is longer above than below: it stands on its head" if overturned(asset.label, _solid(asset)) else ""


def _solid(asset: Asset) -> torch.Tensor:
    """Means `[M, 3]` of an asset's splats that are not faint."""
    return asset.gaussians.means[torch.sigmoid(asset.gaussians.logit_opacities) > 0.3]


def _check_size(file: Path, label: str, size: list[float], scale: float, axes: tuple[str, str], force: bool) -> None:
    if not force and (odd := odd_size(label, size, scale, axes)):
        raise ValueError(f"{file} {odd}, or --force to keep it so")


def _check_upright(file: Path, label: str, points: torch.Tensor, up: str, force: bool) -> None:
    if not force and overturned(label, points):
        raise ValueError(
            f"{file} is longer above than below, so it seems to stand on its head; give --up={_opposite(up)}, or --force to keep it so"
        )


def _opposite(axis: str) -> str:
    return axis[1:] if axis.startswith("-") else f"-{axis}"


def _facing(asset: Asset, forward: str) -> str:
    """What to do about an asset, made with that axis of its file ahead, that seems to face backwards; '' of others."""
    return f"; it {BACKWARDS}; if it does, add it with --forward={_opposite(forward)}" if backwards(asset) else ""


def _told(asset: Asset) -> str:
    return "{:.2f} m long, {:.2f} m wide, {:.2f} m high, {} splats".format(*asset.size.tolist(), len(asset.gaussians))
