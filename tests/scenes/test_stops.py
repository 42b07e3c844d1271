"""What asks work to end is heard between its steps, and only there."""

import errno
import os
import signal

import pytest

from scenes.stops import Stops, resumed, stopped_saying


@pytest.mark.parametrize(("number", "ends"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_stop_waits_for_the_step_and_a_second_one_does_not(number, ends):
    before, done = signal.getsignal(number), []
    with pytest.raises(ends) as end, Stops() as stops:
        stops.end()
        os.kill(os.getpid(), number)
        done.append("step")
        assert stops.asked == number
        stops.end()
    assert done == ["step"] and signal.getsignal(number) is before
    assert getattr(end.value, "code", 143) == 143
    with pytest.raises(ends), Stops():
        os.kill(os.getpid(), number)
        done.append("first")
        os.kill(os.getpid(), number)
        done.append("second")
    assert done == ["step", "first"]


def test_a_stop_after_the_last_step_is_heard_too():
    with pytest.raises(KeyboardInterrupt), Stops():
        os.kill(os.getpid(), signal.SIGINT)


def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Stops() as stops:
            os.kill(os.getpid(), signal.SIGINT)
        assert stops.asked is None and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("stop", "told"), [(KeyboardInterrupt, "interrupted"), (SystemExit, "stopped")])
def test_who_stops_is_told_how_it_goes_on(stop, told, capsys):
    with pytest.raises(stop) as end, stopped_saying(lambda: "give the command again"):
        raise stop
    assert f"{told}; give the command again" in str(end.value) + capsys.readouterr().err


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.ENOENT])
def test_whose_disk_is_full_is_told_how_it_goes_on_from_what_was_kept(code, tmp_path):
    checkpoint, notes = tmp_path / "s1.fit", []
    for _ in range(2):
        with pytest.raises(OSError) as end, stopped_saying(lambda: resumed(checkpoint)):
            raise OSError(code, os.strerror(code), str(checkpoint))
        notes += getattr(end.value, "__notes__", [])
        checkpoint.touch()
    told = ["nothing was kept yet; give the command again", "the same command with --resume goes on from here"]
    assert notes == (told if code != errno.ENOENT else [])
