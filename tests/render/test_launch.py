"""Launching: compiling is said aloud once, and only where it takes a while."""

import errno
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
import torch

from render import launch
from scenes.atomic import atomic_file

CPU = torch.device("cpu")


class Kernel:
    def __init__(self, seconds: float):
        self.module = SimpleNamespace(load=lambda device, block_dim: time.sleep(seconds))


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(launch, "PATIENCE", 0.05)
    launch._say_compiling.cache_clear()


def test_a_kernel_that_has_to_be_compiled_is_announced_once(capsys):
    for _ in range(2):
        launch._ready(Kernel(0.3), "cpu")
    assert capsys.readouterr().err.count("sidestep: compiling kernels") == 1


def test_a_kernel_that_is_compiled_is_loaded_silently(capsys):
    launch._ready(Kernel(0.0), "cpu")
    time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_where_compiled_kernels_cannot_be_kept_another_folder_is_asked_for_and_no_clip_is_blamed(tmp_path):
    def load(device: str, block_dim: int):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    full = Kernel(0.0)
    full.module.load = load
    with pytest.raises(OSError, match="kept in .*: No space left on device; .*WARP_CACHE_PATH") as said, atomic_file(tmp_path / "a.mp4"):
        launch._ready(full, "cpu")
    assert "a.mp4" not in str(said.value)


def test_a_home_that_takes_no_files_is_told_with_what_to_do(tmp_path):
    (tmp_path / "file").touch()
    call = [sys.executable, "-c", "import render.launch"]
    run = subprocess.run(call, env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file")}, capture_output=True, text=True)
    assert f"compiled kernels cannot be kept in {tmp_path / 'file'}" in run.stderr.splitlines()[-1] and "WARP_CACHE_PATH=" in run.stderr


def test_a_kernel_is_compiled_once():
    from render.kernels.sky import lay_behind
    from render.sky import over_sky
    from tests.render.test_sky import CAMERAS, picture

    over_sky(*picture(CAMERAS["pinhole"]), CAMERAS["pinhole"])
    assert {block_size for _, block_size in lay_behind.module.execs} == {1}


def in_stage() -> tuple[int, int]:
    """Threads that bands have in a stage, and torch after it."""
    with launch.stage(CPU):
        bands = launch._cores.threads
    return bands, torch.get_num_threads()


@pytest.fixture
def three_threads(torch_threads):
    torch_threads(3)


def test_a_thread_that_begins_during_anothers_stage_has_all_threads(three_threads):
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        with launch.stage(CPU):
            assert first.submit(in_stage).result() == (3, 3)
            torch.set_num_threads(1)  # as if this stage had begun after that one
            second.submit(torch.get_num_threads).result()  # which is told 1, and may believe it
        assert second.submit(in_stage).result() == (3, 3)
        assert first.submit(in_stage).result() == (3, 3)
    assert torch.get_num_threads() == 3 and launch._stages.open == 0


def test_a_thread_keeps_what_it_was_set_to(three_threads):
    def alone() -> tuple[int, int]:
        torch.set_num_threads(1)
        return in_stage()

    told = []
    worker = threading.Thread(target=lambda: told.append(alone()))
    worker.start()
    worker.join()
    assert told == [(1, 1)] and in_stage() == (3, 3)
