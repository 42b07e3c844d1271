"""Seconds to the first frame of the bundled scene in a fresh process, with an empty kernel cache and with a full one.

python -m tests.bench.first
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

WORK = """
import time
began = time.perf_counter()
from render import rasterize
from tests.bench.presets import drive
imported = time.perf_counter()
preset = drive(640, 360)
loaded = time.perf_counter()
rasterize(preset.placed, preset.camera, ("rgb",), model=preset.model)
drawn = time.perf_counter()
print(f"{imported - began:.2f} | {loaded - imported:.2f} | {drawn - loaded:.2f}")
"""


def main() -> None:
    print("| kernel cache | imports, s | opening the scene, s | first frame, s |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for cache in ("empty", "full"):
            environment = os.environ | {"WARP_CACHE_PATH": folder}
            done = subprocess.run([sys.executable, "-c", WORK], env=environment, stdout=subprocess.PIPE, text=True, check=True)
            print(f"| {cache} | {done.stdout.strip()} |")


if __name__ == "__main__":
    main()
