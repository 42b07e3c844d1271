"""The command line as tests call it in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]

SHOOT = ["render", "street", "--camera", "front_camera", "-o", "x.mp4"]
"""A render of the scene on the desk (`tests/conftest.py`)."""


def sidestep(folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess:
    """Run the command line in a folder and check its exit code; never a traceback."""
    run = subprocess.run([sys.executable, "-m", "sidestep", *words], cwd=folder, env=environment(), capture_output=True, text=True)
    assert run.returncode == code, run.stderr
    assert "Traceback" not in run.stderr
    return run


def environment() -> dict[str, str]:
    """What such a process needs to find Sidestep, and lines too long to be wrapped."""
    return {**os.environ, "PYTHONPATH": str(REPOSITORY), "COLUMNS": "400"}
