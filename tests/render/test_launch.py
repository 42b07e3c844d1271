"""Launching: compiling is said aloud once, and only where it takes a while."""

import time
from types import SimpleNamespace

import pytest

from render import launch


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


def test_a_kernel_is_compiled_once():
    from render.kernels.sky import lay_behind
    from render.sky import over_sky
    from tests.render.test_sky import CAMERAS, picture

    over_sky(*picture(CAMERAS["pinhole"]), CAMERAS["pinhole"])
    assert {block_size for _, block_size in lay_behind.module.execs} == {1}
