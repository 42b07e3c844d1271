"""A camera of one's own on the recording car, as a small JSON file describes it: what the file does not say is as one of the rig's is."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from scenes.camera import RigCamera
from scenes.ground import Ground
from scenes.lenses import Fisheye, Lens, OpenCV, Orthographic, Pinhole
from scenes.lenses.angles import Angular
from scenes.metres import require_metres
from scenes.names import absent, nearest, unknown
from scenes.options import LARGEST
from scenes.poses import CAM_FROM_FLU
from scenes.scene import Scene
from scenes.spread import spread

WIDEST = {"pinhole": 179.0, "fisheye": 360.0}
"""Degrees that a lens sees at most, a fisheye from corner to corner, by the kinds that there are; all see at least one."""

LOOKS = 50
"""Places along the drive at which it is looked how high the car is above the ground."""


@dataclass(frozen=True)
class Numbers:
    """What a key takes: numbers from the least to the most, one, or a list of as many as `counts` has."""

    least: float
    most: float
    example: str
    counts: tuple[int, ...] = ()
    whole: bool = False

    def of(self, said: str, value: Any) -> list:
        """The numbers of a value; ValueError that begins with what is `said` of it."""
        values = value if self.counts and isinstance(value, list) else [value]
        if (self.counts and (not isinstance(value, list) or len(value) not in self.counts)) or not all(map(self._right, values)):
            kind = "whole number" if self.whole else "number"
            what = f"a list of {' or '.join(map(str, self.counts))} {kind}s" if self.counts else f"a {kind}"
            meant = re.match(r"\s*(-?\d+(\.\d+)?)", value) if isinstance(value, str) and not self.counts else None
            fix = meant[1] if meant else self.example
            raise ValueError(f"{said} is {json.dumps(value)}, but it takes {what}, without units; write it as {fix}")
        if bad := [v for v in values if not self.least <= v <= self.most]:
            near = min(max(bad[0], self.least), self.most)
            raise ValueError(f"{said} is {json.dumps(value)}, but it can be from {self.least:g} to {self.most:g}; the nearest is {near:g}")
        return values

    def _right(self, value: Any) -> bool:
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return number and not (self.whole and value != int(value))


ANGLES = {"yaw_deg": Numbers(-360, 360, "45"), "pitch_deg": Numbers(-90, 90, "-10"), "roll_deg": Numbers(-360, 360, "0")}
"""To the left, up and to the right."""

CALIBRATED = {name: Numbers(1, 1e6, "1060.5") for name in ("fx", "fy")} | {name: Numbers(-1e6, 1e6, "960.2") for name in ("cx", "cy")}

NUMBERS = {
    "moved_m": Numbers(-100, 100, "[0, 0, 0.5] (forward, left, up)", (3,)),
    "height_m": Numbers(0.01, 100, "0.5"),
    **ANGLES,
    "angle_of_view_deg": Numbers(1, max(WIDEST.values()), "120"),
    "size": Numbers(1, LARGEST, "[1280, 720]", (2,), whole=True),
    **CALIBRATED,
    "distortion": Numbers(-1e6, 1e6, "[-0.3, 0.1, 0, 0] (OpenCV's order)", (4, 5, 8, 12)),
}
KEYS = ("like", "lens", *NUMBERS)

MOVES = {"like", "moved_m", "height_m"}
"""Keys by which a camera is only moved."""


def described(file: Path) -> dict[str, Any]:
    """What a file says of a camera, by `KEYS`. ValueError naming file, key and fix where it is bad; FileNotFoundError."""
    if not file.exists():
        raise FileNotFoundError(absent(file))
    try:
        said = json.loads(file.read_text(encoding="utf-8-sig"), object_pairs_hook=lambda pairs: _once(file, pairs))
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not a text file in UTF-8; save it as that") from error
    except json.JSONDecodeError as error:
        raise ValueError(f'{file}, line {error.lineno}: {error.msg}, so it is no JSON; write it as {{"height_m": 0.5}}') from error
    if not isinstance(said, dict) or not said:
        raise ValueError(f'{file} describes no camera; write one or more of {", ".join(KEYS)} in braces, as {{"height_m": 0.5}}')
    for key, value in said.items():
        if key not in KEYS:
            raise ValueError(f'{file} has the unknown key "{key}"; there are {", ".join(KEYS)}.{nearest(key, KEYS)}')
        if key in NUMBERS:
            NUMBERS[key].of(f"{file}: {key}", value)
        elif not isinstance(value, str):
            raise ValueError(f'{file}: {key} is {json.dumps(value)}, but it takes a name; write it as "{key}": "NAME"')
    return said


def own_camera(scene: Scene, file: Path) -> RigCamera:
    """The camera that a file describes, on a scene's rig. Exposure, shutter and clock are those of the camera that it is like.

    ValueError where the file is bad, or asks for metres of a scene that has none; FileNotFoundError.
    """
    said = described(file)
    name = said.get("like", next(iter(scene.rig), ""))
    if name not in scene.rig:
        raise ValueError(f"{file}: {unknown('camera', name, 'the rig', scene.rig)}")
    like = scene.rig[name]
    width, height = map(int, said.get("size", (like.width, like.height)))
    mount, lens = _mount(scene, file, said, like), _lens(file, said, like, width, height)
    lit = like.flat_field if said.keys() <= MOVES else None  # it is of that lens, and of where the sun stands before it
    own = replace(like, lens=lens, width=width, height=height, body_from_cam=mount, fitted=False, flat_field=lit)
    return replace(own, trained_focal=_trained_focal(scene, like, own))


def _once(file: Path, pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{file} says {twice} twice; say it once")
    return dict(pairs)


def _mount(scene: Scene, file: Path, said: dict[str, Any], like: RigCamera) -> torch.Tensor:
    """`body_from_cam` `[4, 4]`."""
    mount = like.body_from_cam.clone()
    for key in {"moved_m", "height_m"} & said.keys():
        require_metres(scene, f"{file}: {key}")
    moved = said.get("moved_m", (0, 0, 0))
    mount[:3, 3] += torch.tensor(moved, dtype=torch.float64)
    if "height_m" in said:
        if moved[2]:
            raise ValueError(f"{file}: height_m is how high it is, and moved_m moves it up by {moved[2]:g}; write 0 there, or no height_m")
        if scene.ground is None:
            raise ValueError(f"{file}: height_m needs a scene whose ground is known; say by moved_m how far up from the camera it is like")
        mount[2, 3] = _ground_below(scene, scene.ground, mount) + said["height_m"]
    elif moved[2] < 0 and scene.ground is not None and (above := float(mount[2, 3] - _ground_below(scene, scene.ground, mount))) <= 0:
        raise ValueError(f"{file}: moved_m puts it {-above:.2f} m below the ground; move it down by less than {-moved[2] + above:.2f}")
    if not ANGLES.keys() & said.keys():
        return mount
    r = mount[:3, :3] @ CAM_FROM_FLU[:3, :3]
    now = torch.atan2(r[1, 0], r[0, 0]), torch.atan2(r[2, 0], r[:2, 0].norm()), torch.atan2(r[2, 1], r[2, 2])
    yaw, pitch, roll = (math.radians(said[key]) if key in said else float(v) for key, v in zip(ANGLES, now, strict=True))
    mount[:3, :3] = _about(2, yaw) @ _about(1, -pitch) @ _about(0, roll) @ CAM_FROM_FLU[:3, :3].T
    return mount


def _ground_below(scene: Scene, ground: Ground, mount: torch.Tensor) -> float:
    """The body's z of the ground below what is mounted on it, in the middle over the drive."""
    bodies = torch.stack(spread(list(scene.ego.world_from_body), LOOKS))
    feet = bodies @ torch.tensor([*mount[:2, 3].tolist(), 0.0, 1.0], dtype=torch.float64)
    return float(((ground.height(feet[:, :2]) - feet[:, 2]) / bodies[:, 2, 2]).median())


def _about(axis: int, angle: float) -> torch.Tensor:
    """The rotation `[3, 3]` about an axis of the body, right-handed."""
    turn, (i, j) = torch.eye(3, dtype=torch.float64), ((axis + 1) % 3, (axis + 2) % 3)
    turn[i, i] = turn[j, j] = math.cos(angle)
    turn[i, j], turn[j, i] = -math.sin(angle), math.sin(angle)
    return turn


def _lens(file: Path, said: dict[str, Any], like: RigCamera, width: int, height: int) -> Lens:
    kind = said.get("lens")
    if kind is not None and kind not in WIDEST:
        raise ValueError(f'{file}: lens "{kind}" is not one of {", ".join(WIDEST)}.{nearest(kind, WIDEST)}')
    lacks = [key for key in (*CALIBRATED, "size") if key not in said]
    given = [key for key in (*CALIBRATED, "distortion") if key in said]
    if given:
        if lacks:
            told = "a calibrated lens has fx, fy, cx, cy and the size of the pictures that they are of"
            raise ValueError(f"{file} gives {', '.join(given)} without {', '.join(lacks)}; {told}")
        if "angle_of_view_deg" in said:
            raise ValueError(f"{file} gives angle_of_view_deg and {given[0]}, which say the same; leave out one of them")
        bends = said.get("distortion", [])
        if kind == "fisheye" and bends and len(bends) != 4:
            raise ValueError(f"{file}: distortion has {len(bends)} numbers, but a fisheye lens has the 4 of OpenCV's fisheye module")
        numbers = (*(float(said[key]) for key in CALIBRATED), *map(float, bends))
        return Fisheye(*numbers) if kind == "fisheye" else OpenCV(*numbers) if any(bends) else Pinhole(*numbers[:4])
    own = kind or ("fisheye" if isinstance(like.lens, Angular) else "pinhole")
    if "angle_of_view_deg" not in said and kind in (None, like.lens.kind):  # as recorded, with rows more or fewer above and below
        lens = like.lens.scaled(width / like.width, width / like.width)
        return replace(lens, cy=lens.cy + (height - like.height * width / like.width) / 2)
    angle = float(said["angle_of_view_deg"]) if "angle_of_view_deg" in said else math.degrees(_angle_of_view(like))
    widest = {kind: math.floor(most if kind == "pinhole" else most * width / math.hypot(width, height)) for kind, most in WIDEST.items()}
    if angle > widest[own]:
        other = f', or "lens": "fisheye", which sees up to {widest["fisheye"]} at {width}x{height}' if own == "pinhole" else ""
        told = f"a {own} lens of {width}x{height} pixels sees at most {widest[own]}"
        raise ValueError(f"{file}: angle_of_view_deg is {angle:g}, but {told}; write that{other}")
    half = math.radians(angle) / 2
    focal = width / 2 / (math.tan(half) if own == "pinhole" else half)
    return (Pinhole if own == "pinhole" else Fisheye)(focal, focal, width / 2, height / 2)


def _angle_of_view(camera: RigCamera) -> float:
    """Radians from the left edge of the image to the right one, at the height of its middle."""
    middle = torch.tensor([[0.0, camera.height / 2], [camera.width, camera.height / 2]], dtype=torch.float64)
    left, right = camera.lens.unproject(middle)
    return float(torch.atan2(right[0], right[2]) - torch.atan2(left[0], left[2]))


def _trained_focal(scene: Scene, like: RigCamera, own: RigCamera) -> float | None:
    """Pixels a radian of the rig's camera that looks most as a camera of one's own does, to a degree: of several the one it is like, or the
    sharpest. Splats that are too wide for what they were fitted to cost most: 5 dB ahead in a wide view, drawn as side cameras' splats."""

    def off(camera: RigCamera) -> tuple[int, bool, float]:
        turned = math.acos(float((camera.body_from_cam[:3, 2] @ own.body_from_cam[:3, 2]).clamp(-1, 1)))
        return round(math.degrees(turned)), camera is not like, -max(camera.lens.focal())

    fitted = [c for c in scene.rig.values() if c.fitted and not isinstance(c.lens, Orthographic)]
    return max(min(fitted, key=off).lens.focal()) if fitted else None
