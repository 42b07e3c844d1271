"""Mutated splat files: `python -m tests.fuzz [COUNT]` prints what becomes of COUNT of each format (1000 unless told)."""

from __future__ import annotations

import gzip
import io
import json
import resource
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes import load
from scenes.formats import FORMATS, SPZ, SUFFIXES
from scenes.formats.spz import save_spz
from tests.randomized import gaussians

EXTREMES = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**53, 2**63 - 1, 2**64 - 1]


@dataclass
class Result:
    """What became of `files` mutated files: how many loaded, how many were refused by a ValueError; the worst seconds and MiB of growth."""

    suffix: str
    files: int
    loaded: int
    refused: int
    seconds: float
    mib: float
    others: dict[str, int]


def mutated(dice: np.random.Generator, data: bytes) -> bytes:
    """One to three of: bytes changed, a part cut, repeated, zeroed or grown; a number of the header made extreme; a digit changed."""
    data = bytearray(data)
    for _ in range(dice.integers(1, 4)):
        size = len(data)
        if not size:
            break
        at = int(dice.integers(size) if dice.random() < 0.5 else dice.integers(min(size, 600)))
        length = int(dice.integers(1, 1 + min(size - at, 64)))
        match dice.integers(7):
            case 0:
                data[at : at + length] = dice.bytes(length)
            case 1:
                del data[at : (at + length if dice.random() < 0.5 else size)]
            case 2:
                data[at:at] = data[at : at + length]
            case 3:
                data[at : at + length] = bytes(length)
            case 4:
                data += dice.bytes(length)
            case 5:
                width = int(dice.choice([1, 2, 4, 8]))
                value = EXTREMES[dice.integers(len(EXTREMES))] % 256**width
                data[at : at + width] = value.to_bytes(width, "little")
            case 6:
                digits = [i for i in range(at, min(size, at + 400)) if chr(data[i]).isdigit()]
                if digits:
                    data[digits[dice.integers(len(digits))]] = int(dice.choice(list(b"0123456789-e.")))
    return bytes(data)


def whole(suffix: str, folder: Path) -> list[bytes]:
    """Files to begin with: of few splats, so that most bytes are header; of some, so that there is something to unpack."""
    out = []
    for count, coefficients in ((3, 4), (300, 1), (2, 16)):
        path = folder / f"whole{suffix}"
        versions = (2, 3, 4) if suffix in SPZ.suffixes else (None,)
        for version in versions:
            splats = gaussians(count, coefficients)
            form = next(f for f in FORMATS if suffix in f.suffixes)
            save_spz(path, splats, version) if version else form.save(path, splats)
            out.append(path.read_bytes())
    return out


def damaged(dice: np.random.Generator, data: bytes) -> bytes:
    """A mutated file; of a compressed one often the inside, packed again, since a checksum would hide it from the reader."""
    if data[:2] == b"\x1f\x8b" and dice.random() < 0.7:
        return gzip.compress(mutated(dice, gzip.decompress(data)), 1)
    if data[:2] == b"PK" and dice.random() < 0.8:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
            names = old.namelist()
            chosen = "meta.json" if dice.random() < 0.6 else names[dice.integers(len(names))]
            for name in names:
                new.writestr(name, mutated(dice, old.read(name)) if name == chosen else old.read(name))
        return out.getvalue()
    return mutated(dice, data)


def fuzz(suffix: str, count: int, folder: Path, seed: int = 0) -> Result:
    """Load `count` damaged files of a format in this process."""
    dice, ends, worst = np.random.default_rng(seed), Counter(), 0.0
    seeds = whole(suffix, folder)
    path = folder / f"damaged{suffix}"
    path.write_bytes(seeds[0])
    load(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(count):
        path.write_bytes(damaged(dice, seeds[dice.integers(len(seeds))]))
        start = time.monotonic()
        try:
            load(path)
            ends["loaded"] += 1
        except ValueError as error:
            ends["refused" if str(path) in str(error) else f"ValueError without its file: {error}"[:80]] += 1
        except Exception as error:
            ends[f"{type(error).__name__}: {error}"[:80]] += 1
        worst = max(worst, time.monotonic() - start)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return Result(suffix, count, ends.pop("loaded", 0), ends.pop("refused", 0), worst, grown, dict(ends))


def main(count: int) -> int:
    """Each format in a process of its own, which a crash would end; prints a table and returns the number of bad ends."""
    print("| file | mutated | loaded | refused | anything else | slowest s | memory growth MiB |", flush=True)
    print("|---|---|---|---|---|---|---|", flush=True)
    bad = 0
    for suffix in (s for s in SUFFIXES if s != ".usd"):
        code = "import json, sys, pathlib, tests.fuzz as f; folder = pathlib.Path(sys.argv[1]);"
        code += f"print(json.dumps(vars(f.fuzz({suffix!r}, {count}, folder))))"
        with tempfile.TemporaryDirectory() as folder:
            try:
                run = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, timeout=60 + 2 * count)
                ended = f"crashed, {run.returncode}: {run.stderr.strip()[-200:]}" if run.returncode else ""
            except subprocess.TimeoutExpired:
                ended = "hung"
        if ended:
            print(f"| {suffix} | {count} | | | {ended} | | |", flush=True)
            bad += 1
            continue
        r = Result(**json.loads(run.stdout.splitlines()[-1]))
        others = "; ".join(f"{n} x {what}" for what, n in r.others.items()) or "0"
        print(f"| {suffix} | {r.files} | {r.loaded} | {r.refused} | {others} | {r.seconds:.2f} | {r.mib:.0f} |", flush=True)
        bad += len(r.others)
    return bad


if __name__ == "__main__":
    sys.exit(bool(main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)))
