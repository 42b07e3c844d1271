"""The house stands: imports run one way, and what must be light is light."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
COMMANDS = ["recon", "assets", "insert", "edit", "render", "pairs", "train", "enhance", "convert", "info", "validate", "doctor", "demo"]
ORDER = ["scenes", "render", "recon", "enhance"]
PAGES = [page for room in ("", *ORDER, "tests", "examples") for page in (REPOSITORY / room).glob("**/*.md" if room else "*.md")]


def imported_packages(path: Path) -> set[str]:
    """Top-level names that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno} imports relatively; packages here are imported flat"
            found.add((node.module or "").split(".")[0])
    return found


def loaded(code: str, *arguments: str) -> tuple[set[str], int]:
    """Top-level modules that `code` loads in a fresh interpreter, and how that interpreter ends."""
    tail = "\nimport sys; print('LOADED', *sorted({m.split('.')[0] for m in sys.modules}))"
    run = subprocess.run([sys.executable, "-c", code + tail, *arguments], capture_output=True, text=True, cwd=REPOSITORY)
    lines = [line for line in run.stdout.splitlines() if line.startswith("LOADED")]
    assert lines, run.stderr
    return set(lines[-1].split()[1:]), run.returncode


@pytest.mark.parametrize("package", ORDER)
def test_imports_run_one_way(package):
    above = set(ORDER[ORDER.index(package) + 1 :]) | {"sidestep", "tests", "examples"}
    for path in sorted((REPOSITORY / package).rglob("*.py")):
        wrong = imported_packages(path) & above
        assert not wrong, f"{path.relative_to(REPOSITORY)} imports {', '.join(sorted(wrong))}, which stands above {package}"


def test_imports_in_recon_run_down_the_table_of_its_page():
    room = REPOSITORY / "recon"
    first = [line.split(" | ")[0] for line in (room / "README.md").read_text(encoding="utf-8").splitlines() if line.startswith("| [")]
    order = [Path(target).stem for target in re.findall(r"\]\(([^)]+)\)", "".join(first))]
    files = {path: path.relative_to(room).parts[0].removesuffix(".py") for path in sorted(room.rglob("*.py"))}
    del files[room / "__init__.py"]
    assert sorted(order) == sorted(set(files.values()))
    for path, name in files.items():
        modules = [node.module or "" for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        wrong = {module.split(".")[1] for module in modules if module.startswith("recon.")} - set(order[order.index(name) :])
        assert not wrong, f"{path.relative_to(REPOSITORY)} imports {', '.join(sorted(wrong))}, which recon/README.md has before {name}"


def test_scenes_do_not_know_warp():
    for path in (REPOSITORY / "scenes").rglob("*.py"):
        assert "warp" not in imported_packages(path), path


def test_importing_scenes_loads_torch_and_numpy_only():
    modules, _ = loaded("import scenes; from scenes import Scene, load, save, Databank")
    assert {"torch", "numpy"} <= modules
    assert not modules & {"warp", "pxr", "kornia", "scipy", "pandas", "trimesh", "av", "PIL", "render"}


@pytest.mark.parametrize("package", ORDER)
def test_idle_workers_are_told_to_wait_before_torch_is_loaded(package):
    code = f"import os; os.environ.pop('OMP_WAIT_POLICY', None); import {package}; assert os.environ['OMP_WAIT_POLICY'] == 'passive'"
    modules, _ = loaded(code)
    assert "torch" not in modules


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        *([command, "--help"] for command in COMMANDS),
        ["render", "somewhere", "--camera", "front_camera", "--lateral-shift", "2", "-o", "out.mp4"],
        ["render", "somewhere", "--camera", "front_camera", "--insert", "car/0003@12,3.5m", "-o", "out.mp4"],
        ["insert", "somewhere", "--asset", "car/0003", "--at", "20m"],
        ["rendr"],
    ],
)
def test_help_and_usage_errors_load_nothing_heavy(arguments):
    code = "import sys, sidestep\ntry: sidestep.main(sys.argv[1:])\nexcept SystemExit as end: print('ENDED', end.code)"
    modules, _ = loaded(code, *arguments)
    assert not modules & {"torch", "numpy", "warp", "scenes.gaussians", "PIL", "av"}


def headings(page: Path) -> set[str]:
    """Of a page, as GitHub names them in links."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_in_the_pages_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" not in target:
            path, _, heading = target.partition("#")
            there = (page.parent / path).resolve() if path else page
            assert there.exists(), target
            assert not heading or heading in headings(there), target
