"""Two at once change one folder: one waits for the other."""

import os
import threading
import time

import pytest
from street import car

from scenes import Databank, load, save
from scenes.alone import alone, check_still, sole
from scenes.edit import Edit
from scenes.usd.edit import add_change
from scenes.usd.undo import undone

fcntl = pytest.importorskip("fcntl")


def asked(folder, then):
    """A thread that asks for the folder, and calls `then` when it has it."""

    def run():
        with alone(folder):
            then()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_who_asks_second_waits_until_the_first_is_done_even_if_that_fails(tmp_path):
    said = []
    with pytest.raises(KeyError), alone(tmp_path), alone(tmp_path):  # nested by one thread
        other = asked(tmp_path, lambda: said.append("second"))
        time.sleep(0.2)
        said.append("first")
        raise KeyError
    other.join(5)
    assert said == ["first", "second"]


def test_another_process_waits_too(tmp_path):
    with alone(tmp_path):
        handle = os.open(tmp_path, os.O_RDONLY)  # as another process has it
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(handle)


def test_a_folder_that_is_not_there_holds_nobody_up(tmp_path):
    with alone(tmp_path / "new"):
        assert not (tmp_path / "new").exists()


def test_edits_and_assets_wait_for_who_holds_their_folder(street, tmp_path):
    save(street, tmp_path / "s")
    bank = Databank(tmp_path / "bank")
    bank.add(car())
    track = street.actors[0].track

    def undo():
        with undone(tmp_path / "s", ["gone"]):
            pass

    works = [
        ("s", lambda: add_change(tmp_path / "s", "gone", street, Edit(remove=(track,)), {"kind": "edit"})),
        ("s", undo),
        ("bank", lambda: bank.add(car())),
    ]
    for folder, work in works:
        with alone(tmp_path / folder):
            thread = threading.Thread(target=work)
            thread.start()
            thread.join(0.3)
            assert thread.is_alive()
        thread.join(30)
        assert not thread.is_alive()
    assert len(load(tmp_path / "s").actors) == len(street.actors) and len(bank.entries()) == 2


def test_who_waited_for_a_folder_that_was_taken_away_and_made_anew_holds_the_new_one(tmp_path):
    folder = tmp_path / "bank"
    folder.mkdir()
    held = threading.Event()
    with alone(folder):
        other = asked(folder, held.set)
        other.join(0.2)
        folder.rmdir()
        folder.mkdir()
        handle = os.open(folder, os.O_RDONLY)
        fcntl.flock(handle, fcntl.LOCK_EX)  # as a third has it
    other.join(0.3)
    assert not held.is_set()
    os.close(handle)
    other.join(5)
    assert held.is_set()


def test_assets_added_at_once_to_a_databank_that_is_not_there_yet_are_all_in_it(tmp_path, monkeypatch):
    """The second begins when the first has made the folder and not yet the index; it waits, and takes the next number."""
    bank, begun, ids = Databank(tmp_path / "new" / "bank"), threading.Event(), []
    added = Databank._added

    def slowly(self, *about):
        begun.set()
        time.sleep(0.3)
        return added(self, *about)

    monkeypatch.setattr(Databank, "_added", slowly)
    first = threading.Thread(target=lambda: ids.append(bank.add(car())))
    first.start()
    assert begun.wait(30)
    ids.append(bank.add(car()))
    first.join(30)
    assert sorted(ids) == ["car/0001", "car/0002"] == [e.id for e in bank.entries()]


def test_what_one_command_writes_for_hours_no_other_begins(tmp_path):
    with sole(tmp_path / "s"):
        handle = os.open(tmp_path / ".s.busy", os.O_RDWR)
        with pytest.raises(BlockingIOError):
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(FileExistsError, match=r"s is being written by another command .* wait until it is done"), sole(tmp_path / "s"):
            pass
        with sole(tmp_path / "other"):
            pass
    assert not list(tmp_path.iterdir()), "whoever was refused must not take away what holds"
    os.close(handle)
    (tmp_path / ".s.busy").touch()  # a killed one left it
    with pytest.raises(KeyError), sole(tmp_path / "s"):
        raise KeyError
    assert not list(tmp_path.iterdir())


def test_what_is_being_written_is_not_to_be_read_by_any_name(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "pairs")
    with sole(tmp_path / "link"):
        for name in ("pairs", "link"):
            with pytest.raises(FileExistsError, match=f"{name} is being written .* until it is done, or stop it"):
                check_still(tmp_path / name)
            with pytest.raises(FileExistsError, match=f"{name} is being written"), sole(tmp_path / name):
                pass
        check_still(tmp_path / "other")
    check_still(tmp_path / "pairs")
    (tmp_path / ".pairs.busy").touch()  # a killed one left it
    check_still(tmp_path / "pairs")


def test_a_folder_that_may_be_written_beside_which_nothing_may_is_held_by_nothing(tmp_path, monkeypatch):
    """As the root of a disk of one's own."""
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)  # root may write anywhere
    with sole(tmp_path / "disk"):
        assert [p.name for p in tmp_path.iterdir()] == ["disk"]
