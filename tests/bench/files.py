"""Splat formats: what each keeps of a real scene, its bytes a splat, and how long three million splats take to open.

    python -m tests.bench.files [--scene PATH] [--splats 3000000]

The scene is by default the background of the bundled drive. Nothing here asserts a time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import torch

from scenes import Gaussians, load
from scenes.convert import convert
from scenes.formats import FORMATS
from tests.bench.presets import DRIVE


def many(count: int) -> Gaussians:
    """Splats of random values in the range of a real scene's, without harmonics: no file shrinks more than it would."""
    dice = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=dice)

    return Gaussians(20 * normal(count, 3), normal(count, 4), 0.8 * normal(count, 3) - 4, 2 * normal(count), 0.3 * normal(count, 1, 3))


def opened(path: Path) -> tuple[float, float]:
    """Seconds by the clock and of the processor to load and check a file that the disk's cache has."""
    path.read_bytes()
    clock, work = time.monotonic(), time.process_time()
    load(path)
    return time.monotonic() - clock, time.process_time() - work


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, default=DRIVE / "background.usdc")
    parser.add_argument("--splats", type=int, default=3_000_000)
    options = parser.parse_args()
    scene, crowd = load(options.scene), many(options.splats)
    assert isinstance(scene, Gaussians)
    print(f"{options.scene}: {len(scene)} splats, harmonics of degree {scene.sh_degree}; to open: {options.splats} splats\n")
    print("| format | bytes a splat | position m | rotation deg | scale | opacity | coefficient | opens in s (CPU s) |")
    print("|---|---|---|---|---|---|---|---|")
    for form in FORMATS:
        with tempfile.TemporaryDirectory() as folder:
            told = convert(scene, Path(folder) / f"a{form.suffixes[0]}")
            form.save(Path(folder) / f"b{form.suffixes[0]}", crowd)
            clock, work = opened(Path(folder) / f"b{form.suffixes[0]}")
        off = " | ".join(f"{v:.2g}" for v in (told.position, told.rotation, told.scale, told.opacity, told.sh))
        lost = "" if told.lost_degree is None else f", degree {told.lost_degree} lost"
        print(f"| {form.name} `{form.suffixes[0]}` | {told.bytes / told.splats:.1f} | {off}{lost} | {clock:.1f} ({work:.1f}) |", flush=True)


if __name__ == "__main__":
    main()
