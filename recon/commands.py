"""`sidestep recon` and `sidestep assets`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, arg, subcommand

from scenes.alone import sole
from scenes.opening import check_device
from scenes.options import (
    AngleOrNone,
    Axis,
    Effort,
    FitSize,
    Flag,
    FrontNames,
    Label,
    LengthOrNone,
    Output,
    Overwrite,
    Ratio,
    ScenePath,
    Time,
    TimeOrAll,
)
from scenes.stops import resumed, stopped_saying

if TYPE_CHECKING:
    from scenes import Asset


@dataclass
class Recon:
    """Reconstruct a recorded drive as a scene: background, movers (by its boxes, or found in its lidar), sky, exposure; reports its quality
    on held-out frames."""

    data: Positional[Annotated[Path, arg(metavar="DATA")]]
    """Folder of one drive, as pandaset/002: PandaSet, nuScenes, Argoverse 2, Waymo, NCore (its .json), KITTI or COLMAP's, or photos,
    or a video."""
    output: Output
    """Folder of the new scene."""
    cameras: FrontNames = None
    """Cameras to use."""
    start: Time = 0
    """Start time in the drive."""
    duration: TimeOrAll = None
    """Duration of the part of the drive to use."""
    size: FitSize = None
    """Size at which the first camera's pictures are fitted; cameras of another aspect ratio get as many pixels."""
    camera_height: LengthOrNone = None
    """For a COLMAP folder, photos or a video: height of the cameras above the ground, as 1.5m, which makes the scene metric."""
    metres_per_unit: Ratio = None
    """The scale of such a model instead: metres per unit."""
    angle_of_view: AngleOrNone = None
    """For photos or a video: horizontal field of view of the camera, as 58deg; estimated by default, which fails on a straight road."""
    effort: Effort = 1.0
    """Steps and splats, in multiples of what a drive of so many pictures gets by default: 0.3 for a quick look, 3 for sharper pictures."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    resume: Flag = False
    """Resume an interrupted run of the same command."""
    overwrite: Overwrite = False
    """Replace an existing scene."""

    def run(self) -> None:
        from recon import open_log, reconstruct
        from recon.build import check_free
        from recon.checkpoint import checkpoint_path
        from recon.views.frames import check_size

        shelf = self.output.parent
        if not shelf.exists() and shelf.parent.is_dir():
            shelf.mkdir()  # the first scene of scenes/ makes that folder
        check_free(self.output, self.resume, self.overwrite)
        check_device(self.device)
        if self.size is not None:
            check_size(self.size)  # before photos are placed, which takes long
        with sole(self.output):
            log = open_log(self.data, self.camera_height, self.metres_per_unit, self.angle_of_view, (self.start, self.duration))
            with stopped_saying(partial(resumed, checkpoint_path(self.output))):
                reconstruct(
                    log, self.output, cameras=self.cameras, start_us=self.start, duration_us=self.duration,
                    size=self.size, resume=self.resume, overwrite=self.overwrite, device=self.device, effort=self.effort,
                )  # fmt: skip


@dataclass
class Extract:
    """Extract the moving actors and parked vehicles of a scene into the databank, with the scene's photos of them."""

    scene: ScenePath
    """Scene folder."""
    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        from recon import extract_assets

        ids = extract_assets(self.scene, self.databank)
        print(f"{len(ids)} assets of {self.scene} are in {self.databank}: {', '.join(ids)}")


@dataclass
class List:
    """List the assets of the databank."""

    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        from scenes import Databank

        entries = Databank(self.databank).entries()
        for e in entries:
            size = " x ".join(f"{v:.2f}" for v in e.size)
            print(f"{e.id:<20} {size:>18} m  {e.splats:>7} splats  {'?' if e.views is None else e.views:>4} views  {e.licence}")
        print(f"{len(entries)} asset{'s' * (len(entries) != 1)} in {self.databank}")


@dataclass
class Show:
    """Show one asset: size, class, splats, views, licence, thumbnail."""

    id: Positional[Annotated[str, arg(metavar="ID")]]
    """The asset, as car/0003."""
    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        from scenes import Databank

        bank = Databank(self.databank)
        e, asset = bank.entry(self.id), bank.load(self.id)
        thumb = self.databank / e.thumb if e.thumb else "none"
        told = {
            "asset": e.id, "class": e.label, "size": "{:.2f} m long, {:.2f} m wide, {:.2f} m high".format(*e.size), "splats": e.splats,
            "views": "unknown" if e.views is None else e.views, **_seen_from(asset),
            "photos": f"{len(asset.photos)}, whose detail render --enhance lays over its splats" if asset.photos else "none",
            "licence": e.licence, "attribution": e.attribution, "source": e.source,
            "file": self.databank / e.asset, "thumbnail": thumb,
        }  # fmt: skip
        for key, value in told.items():
            print(f"{key:<12} {value}")


def _seen_from(asset: Asset) -> dict[str, str]:
    """Where an asset was seen from, for `assets show`: from how many frames each sector, and from where its look is a guess."""
    from scenes.seen import unseen_sides

    seen = ", ".join(f"{name} {count}" for name, count in asset.meta.get("sectors", {}).items() if count)
    mirrored = " (the other side is its mirror image)" if asset.meta.get("mirrored") else ""
    closed = " and ".join(asset.meta.get("closed", ()))
    guess = ", ".join(unseen_sides(asset)) + (f" ({closed} closed by the outline of the sides)" if closed else "")
    patches = f"{asset.meta['patched_m2']:.1f} m2 of its sides, by what is around them" if asset.meta.get("patched_m2") else ""
    told = {"seen from": seen + mirrored, "a guess from": guess, "holes closed": patches}
    return {key: value for key, value in told.items() if value}


@dataclass
class Add:
    """Add a textured mesh (.glb) or splats (.ply, .usdc, .glb, ...) of your own to the databank, turned and scaled to its frame."""

    file: Positional[Annotated[Path, arg(metavar="FILE")]]
    """Mesh, as car.glb, or splats, as car.ply."""
    label: Label
    """What it is: car, pickup, van, truck, bus, motorcycle, bicycle, pedestrian, cone, sign, tree, or a name of its own."""
    scale: Ratio = None
    """Metres per unit of the file."""
    up: Axis = None
    """Up axis of the file: x, -x, y, ...; by default y for a mesh, as in glTF; for splats y in .glb and .spz, what a USD file says, else
    -y, as cameras have it."""
    forward: Axis = None
    """Forward axis of the file: by default z for a mesh, as in glTF; for splats -z in .spz, x in USD with z up, else z."""
    licence: str = ""
    """Its licence, as "CC BY 3.0"."""
    attribution: str = ""
    """Credit that its licence requires."""
    force: Flag = False
    """Add it even if its size is not plausible for its class."""
    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        from recon.assets.adding import add_mesh, add_splats, holds_splats

        add = add_splats if holds_splats(self.file) else add_mesh
        share = {"licence": self.licence, "attribution": self.attribution}
        id, said = add(self.databank, self.file, self.label, self.scale, self.up, self.forward, share, self.force)
        print(f"added {self.file} to {self.databank} as {id}: {said}")


@dataclass
class Check:
    """Look through the databank for entries that are broken, of the wrong size, or turned; exit 1 where there are any."""

    databank: Path = Path("databank")
    """Folder of the databank."""

    def run(self) -> None:
        from recon.assets.adding import check_databank
        from scenes import Databank

        entries = Databank(self.databank).entries()
        problems = check_databank(self.databank)
        for problem in problems:
            print(problem)
        if problems:
            raise ValueError(f"{self.databank} has {len(problems)} problem{'s' * (len(problems) > 1)}")
        print(f"{len(entries)} assets in {self.databank}, all whole, of their class's size, and upright")


ACTIONS = {"extract": Extract, "add": Add, "list": List, "show": Show, "check": Check}
_Action: Any = Union[tuple(Annotated[action, subcommand(name)] for name, action in ACTIONS.items())]  # noqa: UP007 - made at run time


@dataclass
class Assets:
    """Assets of the databank: extract them from a scene, add your own, list them, show one, check all."""

    action: OmitArgPrefixes[OmitSubcommandPrefixes[_Action]]

    def run(self) -> None:
        self.action.run()
