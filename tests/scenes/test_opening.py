import os
from pathlib import Path

import pytest

from recon.build import check_free
from scenes.opening import fresh


def test_a_folder_that_takes_no_files_is_told_before_work_begins(tmp_path, monkeypatch):
    folder = tmp_path / "theirs"
    folder.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder)  # root may write anywhere
    for refuse in (lambda: fresh(folder / "x.mp4", True), lambda: check_free(folder / "scene")):
        with pytest.raises(PermissionError, match="cannot write .*theirs/.*: .*theirs is not writable; give a folder of your own"):
            refuse()
    assert fresh(tmp_path / "x.mp4", False) == tmp_path / "x.mp4"
