"""What exists: geometry, cameras, actors, scenes and their files. Torch and numpy only, no Warp.

Conventions, said once, here:

world        right-handed, Z up, metres; origin near the first body pose
body, ego    FLU: x forward, y left, z up; a positive lateral shift is left of travel
camera       OpenCV: x right, y down, z forward; pixel centres at +0.5
pose names   `world_from_body`, `body_from_cam`: neighbours cancel when multiplied
poses        float64 `[4, 4]`; splat means are float32 in a local frame near its origin
quaternions  wxyz, normalised on use
time         int64 microseconds; seconds only in text for people
activation   the name carries it: `log_scales`, `logit_opacities`
colour       SH to display-referred sRGB; linear only where a name says `linear`
asset        origin at the base centre of its box, x forward, z up, size `[3]` in metres
depth        z in metres where a ray meets the splats, divided by alpha, inf where alpha is 0; for lenses that see past 90 degrees the
             distance from the eye
flow         position in the other frame minus position in this one, pixels, x right y down
instance     id whose splats weigh most together, -1 (sky) where alpha < 0.5; background 0, actors from 1
"""

import importlib

import scenes.idle  # noqa: F401

_HOME = {
    "Gaussians": "gaussians",
    "Placed": "gaussians",
    "SplatModel": "gaussians",
    "Lens": "lenses",
    "Pinhole": "lenses",
    "OpenCV": "lenses",
    "Fisheye": "lenses",
    "FTheta": "lenses",
    "Equirectangular": "lenses",
    "Orthographic": "lenses",
    "Camera": "camera",
    "RigCamera": "camera",
    "Trajectory": "trajectory",
    "Asset": "asset",
    "Actor": "asset",
    "Deformation": "deformation",
    "Lattice": "deformation",
    "Sky": "sky",
    "Ground": "ground",
    "Scene": "scene",
    "Databank": "databank",
    "Entry": "databank",
    "load": "files",
    "load_dropping": "files",
    "save": "files",
    "add_edit": "usd.edit",
    "describe": "report",
    "validate": "report",
}

__all__ = sorted(_HOME)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'scenes' has no attribute {name!r}")
    return getattr(importlib.import_module(f"scenes.{_HOME[name]}"), name)
