import re
import subprocess
import sys
import tomllib
from pathlib import Path

from enhance.doctor import LIBRARIES, NEEDS, WARP, Finding, Need, examine, report

REPOSITORY = Path(__file__).parents[2]


def need(probe: str, optional: bool = False) -> Need:
    return Need("thing", "some command", "fetch it", probe, optional)


def test_every_package_that_users_install_is_examined():
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = [name for extra, names in project["optional-dependencies"].items() if extra != "test" for name in names]
    wanted = {re.split(r"[<>=~! ]", name)[0] for name in (*project["dependencies"], *extras)}
    assert wanted == {n.name for n in NEEDS} - {"weights"}
    assert {n.name for n in NEEDS if n.optional} == {re.split(r"[<>=~! ]", name)[0] for name in extras}


def test_what_crashes_hangs_or_is_absent_is_found_and_breaks_nothing(monkeypatch):
    monkeypatch.setattr("enhance.doctor.SECONDS", 1)
    probes = [
        "print('chatter'); print('1.2')",
        "import no_such_thing",
        "import os; os.abort()",
        "import time; time.sleep(60)",
        "raise ImportError('libGL.so.1: cannot open shared object file: No such file or directory')",
        "",
    ]
    found = list(examine(tuple(need(probe) for probe in probes)))
    assert [f.state for f in found] == ["ok", "missing", "broken", "broken", "broken", "ok"]
    assert found[0].said == "1.2" and "timed out" in found[3].said
    lines = "\n".join(report(iter(found)))
    assert "apt install libgl1" in lines and "needed: fetch it" in lines and "everything else" not in lines


def test_a_lost_library_is_named_also_where_its_package_is_not_known():
    assert "libGL.so" in LIBRARIES
    said = "libodd.so.3: cannot open shared object file: No such file or directory"
    (line,) = [x for x in report(iter([Finding(need("", True), "broken", said)])) if x.startswith("optional")]
    assert "libodd.so" in line


def test_a_home_that_takes_no_compiled_kernels_asks_for_another_folder_not_for_another_package(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "file"))
    lines = list(report(examine(tuple(n for n in NEEDS if n.name == "warp-lang"))))
    assert any(line.startswith("needed: export WARP_CACHE_PATH=") for line in lines), lines


def test_a_folder_of_kernels_that_takes_no_more_serves_as_far_as_it_goes():
    for folder, said in (("full", "only compiled ones, which cannot be added to: full"), ("bare", "kernels cannot be kept in bare")):
        setting = "import os, tempfile, warp; from pathlib import Path; warp.config.kernel_cache_dir = FOLDER; warp.init = lambda: None\n"
        refusing = (
            "def refuse(dir): raise OSError(30, 'Read-only file system', dir)\ntempfile.TemporaryFile, warp.get_devices = refuse, list\n"
        )
        holding = "os.chdir(tempfile.mkdtemp()); Path('full/wp_one').mkdir(parents=True)\nversion = '1'\n"
        (found,) = examine((need(setting.replace("FOLDER", repr(folder)) + refusing + holding + WARP),))
        assert said in found.said and found.state == ("ok" if folder == "full" else "broken"), found
        assert any("WARP_CACHE_PATH" in line for line in report(iter([found]))) == (folder == "bare")


def test_nothing_lacking_says_so():
    ok = Finding(need(""), "ok", "1.0")
    assert list(report(iter([ok])))[-1] == "every command has what it needs"
    assert list(report(iter([ok, Finding(need("", True), "missing", "not installed")])))[-1] == "everything else has what it needs"


def test_the_doctor_of_this_machine_exits_0():
    run = subprocess.run([sys.executable, "-m", "sidestep", "doctor"], cwd=REPOSITORY, capture_output=True, text=True)
    assert run.returncode == 0 and not run.stderr, run.stderr
    assert re.search(r"^ok +torch +\d", run.stdout, re.M) and "H.264" in run.stdout
