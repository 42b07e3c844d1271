"""A rig's camera as a USD camera, and back."""

from __future__ import annotations

import torch
from pxr import Gf, Usd, UsdGeom

from scenes.camera import RigCamera
from scenes.lenses import LENSES, Orthographic
from scenes.usd.layers import author_pose, local_pose

_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # USD cameras look along -z with y up

_APERTURE = 0.20955  # of a 20.955 mm wide film, in USD's tenths of a scene unit: only its ratio to the focal length counts


def author_camera(stage: Usd.Stage, where: str, camera: RigCamera) -> None:
    """A USD camera that sees what the lens would see without distortion: film offsets point to where the image centre looks."""
    usd = UsdGeom.Camera.Define(stage, where)
    (fx, fy), cx, cy = camera.lens.focal(), float(camera.lens.cx), float(camera.lens.cy)
    parallel = isinstance(camera.lens, Orthographic)
    wide = 10 * camera.width / fx if parallel else _APERTURE  # a parallel view's film is as wide as what it sees, in tenths again
    focal = _APERTURE * fx / camera.width
    tall = wide * fx / camera.width * camera.height / fy
    if parallel:
        usd.CreateProjectionAttr("orthographic")
    else:
        usd.CreateFocalLengthAttr(focal)
    usd.CreateHorizontalApertureAttr(wide)
    usd.CreateVerticalApertureAttr(tall)
    usd.CreateHorizontalApertureOffsetAttr((camera.width / 2 - cx) / camera.width * wide)
    usd.CreateVerticalApertureOffsetAttr((cy - camera.height / 2) / camera.height * tall)
    usd.CreateClippingRangeAttr(Gf.Vec2f(0.05, 100_000.0))
    author_pose(usd.GetPrim(), camera.body_from_cam @ _FLIP)


def load_camera(stage: Usd.Stage, entry: dict, name: str) -> RigCamera:
    """The camera of an entry in metadata.json: its mount is the prim's pose, all else the entry's. ValueError for a camera without a prim,
    and for an unknown lens."""
    prim = stage.GetPrimAtPath(f"/World/Ego/{entry['prim']}")
    if not prim:
        raise ValueError(f"camera {name} is in metadata.json but /World/Ego/{entry['prim']} is not in scene.usda")
    lens = dict(entry["lens"])
    kind = lens.pop("type")
    if kind not in LENSES:
        raise ValueError(f"camera {name} has a {kind} lens; this Sidestep knows {', '.join(LENSES)}")
    exposure = torch.tensor(entry["exposure"], dtype=torch.float32)
    times = torch.tensor(entry["times_us"], dtype=torch.int64)
    shutter = entry.get("shutter", "global"), entry.get("readout_us", 0)  # absent from scenes of before, as what follows
    gains = None if entry.get("gains") is None else torch.tensor(entry["gains"], dtype=torch.float32)
    flat_field = None if entry.get("flat_field") is None else torch.tensor(entry["flat_field"], dtype=torch.float32)
    taken, mount = (exposure, times, *shutter, gains, entry.get("fitted", True), flat_field), local_pose(prim) @ _FLIP
    return RigCamera(LENSES[kind](**lens), entry["width"], entry["height"], mount, *taken)
