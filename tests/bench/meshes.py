"""Meshes as splats: how like the traced mesh each asset looks, from views that it was not fitted to.

    python -m tests.bench.meshes FOLDER [NAME ...] [--splats 30000] [--steps 700]

The table in the README's "Your own asset"; the names are those of its rows where none is given.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from recon.assets.mesh_files import read_mesh
from recon.assets.meshes import MeshFit, asset_of_mesh

NAMES = ("hatchback", "pickup", "prius_hybrid", "fire_hydrant", "construction_cone", "oak_tree")


def row(file: Path, config: MeshFit) -> str:
    """A line of the table: PSNR of the whole picture and over the mesh's own pixels, and CPU seconds."""
    began = time.process_time()
    meta = asset_of_mesh(read_mesh(file), "object", {}, config, lambda step, loss: None).meta
    spent = time.process_time() - began
    return f"| {file.stem} | {meta['psnr_unseen_whole_picture']:.1f} dB | {meta['psnr_unseen']:.1f} dB | {spent:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--splats", type=int, default=MeshFit().splats)
    parser.add_argument("--steps", type=int, default=MeshFit().steps)
    asked = parser.parse_args()
    config = MeshFit(splats=asked.splats, steps=asked.steps)
    size = "x".join(map(str, config.size))
    print(f"| mesh, to {config.splats:,} splats, {size} | PSNR of unseen views | over the mesh's own pixels | CPU s |\n|---|---|---|---|")
    for name in asked.names:
        print(row(asked.folder / f"{name}.glb", config), flush=True)


if __name__ == "__main__":
    main()
