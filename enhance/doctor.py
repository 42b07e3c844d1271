"""`sidestep doctor`: what this machine has of what the commands need, and how to get the rest."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

SECONDS = 120  # a cold import from a slow disk is no fault
WIDTH = 12
HOUSE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Need:
    """Something that may be missing or broken: what for, how to get it, and a program that says on its last line what there is."""

    name: str
    reason: str
    fix: str
    probe: str
    optional: bool = False


@dataclass(frozen=True)
class Finding:
    """What a probe found: "ok", "missing" or "broken", and what it said."""

    need: Need
    state: str
    said: str


def _package(name: str, reason: str, probe: str = "", module: str = "", extra: str = "", fix: str = "") -> Need:
    """A Python package: there if it imports, and then its version, unless `probe` says more."""
    said = f"import importlib.metadata, {module or name}; version = importlib.metadata.version({name!r})\n"
    get = fix or (f"pip install 'sidestep[{extra}]'" if extra else f"pip install {name}")
    return Need(name, reason, get, said + (probe or "print(version)"), bool(extra))


TORCH = """
device = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA device, so --device cpu"
print(f"{version}, {torch.get_num_threads()} threads; {device}")
"""
WARP = """
import tempfile
from pathlib import Path
warp.config.quiet = True
kept = "compiled ones are kept in"
try:
    warp.init()
    tempfile.TemporaryFile(dir=warp.config.kernel_cache_dir)
except OSError as error:
    if error.errno is None:
        raise
    if not any(Path(warp.config.kernel_cache_dir).glob("wp_*")):
        raise OSError(f"compiled kernels cannot be kept in {warp.config.kernel_cache_dir}") from None
    kept = "only compiled ones, which cannot be added to:"
devices = ", ".join(str(device) for device in warp.get_devices())
print(f"{version}, kernels run on {devices}; {kept} {warp.config.kernel_cache_dir}")
"""
AV = "av.codec.Codec('libx264', 'w'), av.codec.Codec('h264', 'r'); print(f'{version}, writes and reads H.264')"
USD = """
from pxr import UsdVol
if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
    raise ImportError(f"{version} has no ParticleField3DGaussianSplat, 26.3 does")
print(version)
"""
PILLOW = """
from PIL import features
if not features.check("webp"):
    raise ImportError(f"{version} was built without WebP")
print(f"{version}, with WebP {features.version('webp')}")
"""
WEIGHTS = """
from enhance.network.weights_file import BUILTIN, load_net
net, about = load_net(BUILTIN)
print(f"{BUILTIN.stat().st_size / 1e6:.1f} MB, {sum(p.numel() for p in net.parameters()) / 1e6:.1f} million parameters")
"""
FFMPEG = "pip install av, whose wheels bring FFmpeg with x264"

LIBRARIES = {
    "libusb-1.0.so": "libusb-1.0-0", "libGL.so": "libgl1", "libEGL.so": "libegl1", "libGLX.so": "libglx0", "libX11.so": "libx11-6",
    "libgomp.so": "libgomp1", "libstdc++.so": "libstdc++6", "libz.so": "zlib1g", "libxcb.so": "libxcb1",
}  # fmt: skip
"""Of shared libraries that wheels take for granted: the Debian and Ubuntu package that brings each."""

NEEDS = (
    _package("numpy", "every command"),
    _package("torch", "every command", TORCH),
    _package("tyro", "every command"),
    _package("usd-core", "every command that opens or writes a scene or asset", USD, module="pxr", fix="pip install 'usd-core>=26.3'"),
    _package("warp-lang", "recon, assets, render, pairs, demo", WARP, module="warp"),
    _package("av", "videos: render, enhance, demo, recon of a video", AV, fix=FFMPEG),
    _package("kornia", "recon, pairs, and the tables of both"),
    _package("safetensors", "train, enhance, render --enhance"),
    _package("scipy", "recon, render --enhance"),
    _package("pandas", "recon of PandaSet"),
    _package("pillow", "pictures; convert to and from .sog", PILLOW, module="PIL"),
    _package("trimesh", "assets add of a mesh"),
    _package("zstandard", "convert to and from .spz"),
    Need("weights", "render --enhance, enhance, demo", "git checkout enhance/weights, or install again", WEIGHTS),
    _package("pyarrow", "recon of Argoverse 2 and Waymo", extra="arrow"),
    _package("nvidia-ncore", "recon of NVIDIA NCore", module="ncore", extra="ncore"),
    _package("pycolmap", "recon of COLMAP folders, photos, videos, and drives without lidar", extra="colmap"),
    _package("diffusers", "enhance and render with --weights of Difix", extra="public"),
)

UNVERIFIED = (
    "unverified: the public models as --weights (NVIDIA Harmonizer and Fixer, Cosmos-Predict2, Difix, Ke et al.'s Harmonizer). Their files "
    "were not at hand: layouts and graphs are tested on small random ones, against diffusers' own classes where there are any; no released "
    "weight was ever read, no picture of theirs compared. Of harmonizer_nontemporal.pt it is not published what it takes: "
    "[1, 3, 576, 1024] in -1..1 is a guess. DiffusionRenderer (pairs --relit) was never run: its files' layout is that of its source"
)
"""What works only as far as it could be tried, said to whoever asks what works."""


@dataclass
class Doctor:
    """Say what is installed, what is missing for which command, and how to get it; always exits 0."""

    def run(self) -> None:
        print("\n".join(report(examine())))


def examine(needs: tuple[Need, ...] = NEEDS) -> Iterator[Finding]:
    """What each need's probe found, in order. Probes run in processes of their own: what crashes or hangs there is only `broken`."""
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        yield from pool.map(_found, needs)


def report(findings: Iterator[Finding]) -> Iterator[str]:
    """Lines to show: the machine, a line a need, and what to do."""
    yield f"Python {platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores, {_memory()}"
    lacking = []
    for finding in findings:
        need = finding.need
        yield f"{finding.state:<8} {need.name:<{WIDTH}} {finding.said}" + ("" if finding.state == "ok" else f"; for {need.reason}")
        if finding.state != "ok":
            lacking.append(replace(need, fix=_cure(finding.said) or need.fix))
    for need in lacking:
        yield f"{'optional' if need.optional else 'needed'}: {need.fix}   # {need.reason}"
    yield UNVERIFIED
    if not lacking:
        yield "every command has what it needs"
    elif all(need.optional for need in lacking):
        yield "everything else has what it needs"


def _found(need: Need) -> Finding:
    try:
        call = [sys.executable, "-c", need.probe]
        run = subprocess.run(call, capture_output=True, text=True, errors="replace", timeout=SECONDS, cwd=HOUSE)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Finding(need, "broken", " ".join(str(error).split())[:200])
    if run.returncode == 0:
        return Finding(need, "ok", (run.stdout.strip().splitlines() or [""])[-1])
    last = (run.stderr.strip().splitlines() or [f"its probe ended with {run.returncode}"])[-1]
    kind, _, why = last.partition(": ")
    if kind == "ModuleNotFoundError" or kind.endswith("PackageNotFoundError"):
        return Finding(need, "missing", "not installed")
    return Finding(need, "broken", (why or last)[:200])


def _cure(said: str) -> str:
    """How to get the shared library that an import did not find, or a folder for kernels; '' where that is not what is wrong."""
    if "kernels cannot be kept" in said:
        return "export WARP_CACHE_PATH=/tmp/kernels"
    lost = re.match(r"(lib[\w.+-]+\.so)[\w.]*: cannot open shared object file", said)
    if not lost:
        return ""
    return f"apt install {LIBRARIES[lost[1]]}" if lost[1] in LIBRARIES else f"install the system's package with {lost[1]}"


def _memory() -> str:
    """The machine's memory in words; nothing that every system tells."""
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB of memory"
    except (AttributeError, OSError, ValueError):
        return "memory unknown"
