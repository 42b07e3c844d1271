"""Fixtures of the whole house: the shared data where there is any, and a made-up street."""

import os
import signal
from pathlib import Path

import pytest

if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    # before anything loads torch: where each has a thread for every core, they wait for one another, and tests take 1.6 times as long
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // int(workers))))

import render  # noqa: E402, F401, I001 - says how OpenMP's workers wait, before anything loads torch
import torch  # noqa: E402

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a script's background jobs do; some tests send it, and it is to be heard
    signal.signal(signal.SIGINT, signal.default_int_handler)

REPOSITORY = Path(__file__).parents[1]


def shared_root() -> Path:
    return Path(os.environ.get("SIDESTEP_SHARED") or REPOSITORY.parent / "shared")


@pytest.fixture
def torch_threads():
    """Sets how many threads torch has, for one test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared data; tests that need it are skipped where it is absent."""
    root = shared_root()
    if not (root / "data").is_dir():
        pytest.skip(f"needs the shared data: no folder {root / 'data'}; set SIDESTEP_SHARED to the folder that holds data/")
    return root / "data"


@pytest.fixture(scope="session")
def pandaset(shared) -> Path:
    """Drive 002 in PandaSet's layout."""
    drive = shared / "pandaset" / "002"
    if not drive.is_dir():
        pytest.skip(f"needs PandaSet drive 002: no folder {drive}")
    return drive


@pytest.fixture(scope="session")
def street():
    """A made-up street, two cameras of 96x54, eight frames; a Scene in memory."""
    import street as made

    return made.street()


@pytest.fixture(scope="session")
def desk(tmp_path_factory) -> Path:
    """A folder with a scene, a databank and a clip; read-only by agreement."""
    import street as made

    from render.video import VideoWriter
    from scenes import Databank, save

    folder = tmp_path_factory.mktemp("desk")
    save(made.street(), folder / "street")
    bank = Databank(folder / "bank")
    bank.add(made.car())
    bank.add(made.car("van", (0.8, 0.8, 0.2)))
    with VideoWriter(folder / "clip.mp4", 10, 64, 48) as video:
        for _ in range(3):
            video.write(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(1)))
    return folder


@pytest.fixture
def door(desk, monkeypatch, capsys):
    """Call the front door in this process, which has its packages loaded: (words, exit code) -> (stdout, stderr)."""
    import sidestep as front

    monkeypatch.chdir(desk)
    monkeypatch.setenv("COLUMNS", "400")
    before = signal.getsignal(signal.SIGTERM)

    def call(words: list[str], code: int = 0) -> tuple[str, str]:
        try:
            front.main(words)
            ended = 0
        except SystemExit as end:
            ended = end.code
        out, errors = capsys.readouterr()
        assert ended == code, errors
        return out, errors

    yield call
    signal.signal(signal.SIGTERM, before)
