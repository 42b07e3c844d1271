"""An asset of your own on the recorded street: a textured mesh becomes splats, stands in the street's light, and casts a shadow."""

from pathlib import Path

import tyro

from recon.assets.adding import add_mesh, check_databank
from recon.assets.meshes import MeshFit
from render import render_clip
from render.video import write_image
from scenes import Databank, load
from scenes.insert import insert
from scenes.light import light_of
from scenes.placement import Placement

DATA = Path(__file__).parent / "data"


def main(
    mesh: Path | None = None,
    label: str = "cone",
    scene: Path = DATA / "drive002",
    databank: Path = Path("own_databank"),
    splats: int = 6000,
    steps: int = 300,
    width: int = 640,
    output: Path = Path("own_asset.png"),
) -> None:
    """Add a mesh (.glb: y up, z forward, metres), or a made-up cone, to a databank and put it onto the street."""
    if mesh is None:
        mesh = made_up_cone(output.with_name("cone.glb"))
    config = MeshFit(splats=splats, steps=steps, views=48, size=(160, 120))
    id, told = add_mesh(databank, mesh, label, 1.0, None, None, {"licence": "CC0-1.0"}, config=config)
    print(f"{id}: {told}", *check_databank(databank), sep="\n")

    drive = load(scene)
    for x in (8.0, 11.0, 14.0):
        result = insert(drive, Databank(databank).load(id), Placement(id, x, 2.0))
        drive = result.scene
        for warning in result.warnings:
            print(warning)
    print("light:", light_of(drive).source)
    time = drive.frame_times("front_camera")[:1]
    (frame,) = render_clip(drive, "front_camera", times_us=time, width=width, height=width * 9 // 16)
    write_image(output, frame.rgb)
    print(f"wrote {output}")


def made_up_cone(path: Path) -> Path:
    """A traffic cone of 90 cm on a square foot, orange with a white band."""
    import numpy as np
    import trimesh

    cone, foot = trimesh.creation.cone(0.2, 0.87, sections=32), trimesh.creation.box((0.5, 0.5, 0.03))
    cone = cone.subdivide().subdivide()
    cone.apply_translation((0, 0, 0.03))
    parts = trimesh.util.concatenate([cone, foot.apply_translation((0, 0, 0.015))])
    white = (parts.vertices[:, 2] > 0.4) & (parts.vertices[:, 2] < 0.6)
    parts.visual.vertex_colors = np.where(white[:, None], (240, 240, 240, 255), (240, 90, 20, 255)).astype(np.uint8)
    parts.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))  # glTF's y is up
    parts.export(path)
    return path


if __name__ == "__main__":
    tyro.cli(main)
