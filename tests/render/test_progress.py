import io
import time

from render.progress import Progress, Stopwatch, progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_elsewhere_than_a_terminal_lines_are_plain():
    out = io.StringIO()
    with Progress("fit", 3, stream=out) as steps:
        for _ in range(3):
            steps.step(note="28.1 dB")
    assert out.getvalue() == "fit 3/3  0 s  28.1 dB\n"


def test_work_that_only_its_note_tells_of_is_told_too(monkeypatch):
    monkeypatch.setattr("render.progress.PLAIN_SECONDS", 0.0)
    out = io.StringIO()
    with Progress("train", 1000, stream=out) as steps:
        for note in ("step 3", "looked at 1 of 2 clips", "looked at 2 of 2 clips"):
            steps.step(1000 - steps.done, note)
    assert [line.split("  ")[-1] for line in out.getvalue().splitlines()] == ["step 3", "looked at 1 of 2 clips", "looked at 2 of 2 clips"]


def test_what_an_earlier_run_and_the_first_step_did_says_nothing_of_the_time_left(monkeypatch):
    steps = Progress("fit", 100, stream=io.StringIO())
    steps.resume(90)
    assert steps.line() == "fit 90/100"
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 100)
    steps.step()  # it compiled kernels, which the others will not
    monkeypatch.setattr(time, "monotonic", lambda: now + 150)
    steps.step(5)
    assert steps.line() == "fit 96/100  40 s left"


def test_a_terminal_gets_a_bar_that_ends_in_a_new_line():
    out = Terminal()
    with Progress("fit", 2, stream=out) as steps:
        steps.step(2)
    assert "[########################] fit 2/2" in out.getvalue()
    assert out.getvalue().endswith("\n")


def test_what_never_began_says_nothing():
    out = io.StringIO()
    try:
        with Progress("enhance clip.mp4", stream=out):
            raise ValueError
    except ValueError:
        assert out.getvalue() == ""


def test_unknown_totals_are_counted_without_a_bar():
    out = Terminal()
    with Progress("decode", stream=out) as steps:
        steps.step(7)
    assert "decode 7" in out.getvalue()
    assert "[#" not in out.getvalue()


def test_items_pass_through(capsys):
    assert list(progress([3, 1, 2], "count")) == [3, 1, 2]
    assert "count 3/3" in capsys.readouterr().err


def test_inner_stages_are_not_counted_to_outer_ones():
    watch = Stopwatch()

    def inner():
        for _ in range(2):
            time.sleep(0.03)
            yield 1

    for _ in watch.during("outer", watch.during("inner", inner())):
        pass
    assert watch.seconds["inner"] >= 0.06
    assert watch.seconds["outer"] < watch.seconds["inner"]
    assert set(watch.milliseconds(2)) == {"outer", "inner"}
