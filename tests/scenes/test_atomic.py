import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from scenes.atomic import atomic_file, atomic_folder, made_folder


def listing(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_file_appears_whole_with_its_suffix_and_usual_rights(tmp_path):
    target, plain = tmp_path / "a.ply", tmp_path / "plain"
    plain.write_text("x")
    with atomic_file(target) as partial:
        assert partial.suffix == ".ply" and partial.parent == tmp_path
        partial.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole" and target.stat().st_mode == plain.stat().st_mode
    assert listing(tmp_path) == ["a.ply", "plain"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device"), ValueError("bad")])
def test_a_broken_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(type(error)), atomic_file(target) as partial:
        partial.write_text("half")
        raise error
    assert target.read_text() == "old" and listing(tmp_path) == ["a.json"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EFBIG, errno.EDQUOT])
@pytest.mark.parametrize("named", [True, False])
def test_a_write_that_fails_names_the_target(tmp_path, code, named):
    with pytest.raises(OSError) as caught, atomic_file(tmp_path / "a.mp4") as partial:
        raise OSError(code, os.strerror(code), *[str(partial)] * named)
    assert caught.value.filename == str(tmp_path / "a.mp4")


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_a_broken_folder_leaves_the_old_one_and_nothing_else(tmp_path, error):
    target = tmp_path / "s1"
    with atomic_folder(target) as partial:
        (partial / "old").write_text("old")
    with pytest.raises(type(error)), atomic_folder(target, replace=True) as partial:
        (partial / "new").write_text("half")
        raise error
    assert listing(tmp_path) == ["s1"] and listing(target) == ["old"]


def test_a_folder_is_replaced_only_when_asked_to(tmp_path):
    target = tmp_path / "s1"
    with atomic_folder(target) as partial:
        (partial / "old").write_text("old")
    with pytest.raises(FileExistsError, match="s1 exists"), atomic_folder(target) as partial:
        pass
    with atomic_folder(target, replace=True) as partial:
        (partial / "new").write_text("new")
    assert listing(tmp_path) == ["s1"] and listing(target) == ["new"]


@pytest.mark.parametrize("exchanged", [True, False])
@pytest.mark.parametrize("link", [True, False])
def test_a_folder_or_a_link_to_one_is_replaced_at_one_go_where_the_disk_can(tmp_path, monkeypatch, exchanged, link):
    (tmp_path / "first").mkdir()
    target = tmp_path / "s1"
    target.symlink_to("first") if link else (tmp_path / "first").rename(target)

    def gone(*_):
        raise AssertionError("for a moment there was no s1")

    if not exchanged:
        monkeypatch.setattr("scenes.atomic._swapped", lambda *_: False)
    elif sys.platform == "linux":
        monkeypatch.setattr(os, "rename", gone)
    with atomic_folder(target, replace=True) as partial:
        (partial / "new").write_text("new")
    assert listing(tmp_path) == ["first"] * link + ["s1"] and listing(target) == ["new"] and not target.is_symlink()


def test_a_folder_whose_new_one_cannot_take_its_name_is_put_back(tmp_path, monkeypatch):
    """Where a disk cannot exchange two names, the old folder is put aside for a moment."""
    target, rename = tmp_path / "s1", os.rename
    with atomic_folder(target) as partial:
        (partial / "old").write_text("old")

    def failing(one, other):
        if (Path(one) / "new").exists():
            raise OSError("no")
        rename(one, other)

    monkeypatch.setattr("scenes.atomic._swapped", lambda *_: False)
    monkeypatch.setattr(os, "rename", failing)
    with pytest.raises(OSError, match="no"), atomic_folder(target, replace=True) as partial:
        (partial / "new").write_text("new")
    assert listing(tmp_path) == ["s1"] and listing(target) == ["old"]


def test_a_killed_process_leaves_nothing_under_the_final_names(tmp_path):
    code = f"""
import os, signal
from scenes.atomic import atomic_file, atomic_folder
with atomic_folder({str(tmp_path / "s1")!r}) as folder, atomic_file({str(tmp_path / "a.ply")!r}) as file:
    (folder / "half").write_text("half"); file.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert all(name.startswith(".") for name in listing(tmp_path))


def test_writing_into_a_missing_folder_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"), atomic_file(tmp_path / "nowhere" / "a.ply"):
        pass
    with pytest.raises(FileNotFoundError, match="nowhere does not exist"), atomic_folder(tmp_path / "nowhere" / "s1"):
        pass


def test_writing_into_a_file_as_if_it_were_a_folder_names_it(tmp_path):
    (tmp_path / "f").write_text("")
    with pytest.raises(NotADirectoryError, match="b: .*/f is a file, not a folder"), atomic_file(tmp_path / "f/a/b"):
        pass
    for path in (tmp_path / "f", tmp_path / "f" / "g"):
        with pytest.raises(NotADirectoryError, match="/f is a file, not a folder; give another name"):
            made_folder(path)


KILLED = """
import os, sys
from scenes.atomic import atomic_file, atomic_folder
with (atomic_folder if sys.argv[2] == "folder" else atomic_file)(sys.argv[1]) as half:
    print(half, flush=True)
    sys.stdin.read()
"""


def test_what_a_killed_process_left_half_goes_with_the_next_write(tmp_path):
    """But not what another target, a process that runs or another machine has, nor files of the user's own."""
    targets = {"out.mp4": "file", "s[1].fit": "file", "s1": "folder", "out_2.mp4": "file", "out": "folder"}
    begun = {}
    for name, kind in targets.items():
        command = [sys.executable, "-c", KILLED, str(tmp_path / name), kind]
        begun[name] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    halves = {name: Path(process.stdout.readline().strip()) for name, process in begun.items()}
    (halves["s1"] / "big").write_text("half of it")
    for name in ("out.mp4", "s[1].fit", "s1", "out_2.mp4"):
        begun[name].kill()
        begun[name].wait()
    (tmp_path / ".out.settings.mp4").touch()
    elsewhere = tmp_path / halves["out.mp4"].name.replace("half-", "half-0")
    elsewhere.touch()
    for path in ("out.mp4", "s[1].fit"):
        with atomic_file(tmp_path / path):
            pass
    for path in ("s1", "out"):
        with atomic_folder(tmp_path / path):
            pass
    kept = [halves["out_2.mp4"].name, halves["out"].name, ".out.settings.mp4", elsewhere.name]
    assert listing(tmp_path) == sorted(["out", "out.mp4", "s1", "s[1].fit", *kept])
    begun["out"].kill()
    begun["out"].wait()


def test_a_folder_is_made_with_those_above_it_and_refused_where_none_takes_files(tmp_path, monkeypatch):
    assert made_folder(tmp_path / "a" / "b").is_dir() and made_folder(tmp_path / "a") == tmp_path / "a"
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path / "a")  # root may write anywhere
    for folder in (tmp_path / "a", tmp_path / "a" / "c" / "d"):
        with pytest.raises(PermissionError, match=rf"cannot write {folder}: .*/a is not writable; give a folder of your own"):
            made_folder(folder)
    assert listing(tmp_path / "a") == ["b"]
