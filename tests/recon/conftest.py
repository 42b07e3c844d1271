import painted
import pytest
from made_colmap import pictures_along, write_colmap
from made_drive import write_drive

from recon.seeds import stereo


@pytest.fixture(scope="session")
def drive(street, tmp_path_factory):
    """The made-up street in PandaSet's layout; not to be changed."""
    return write_drive(tmp_path_factory.mktemp("made") / "drive", street)


@pytest.fixture
def own_drive(drive, tmp_path):
    """A copy of it that a test may break."""
    import shutil

    return shutil.copytree(drive, tmp_path / "drive")


@pytest.fixture(scope="session")
def workspace(street, tmp_path_factory):
    """A COLMAP model of twelve pictures along the street; not to be changed."""
    return write_colmap(tmp_path_factory.mktemp("colmap") / "walk", street, {"": pictures_along(street)})


@pytest.fixture
def own(workspace, tmp_path):
    """A copy of it that a test may break."""
    import shutil

    return shutil.copytree(workspace, tmp_path / "walk")


@pytest.fixture(scope="module")
def small_pictures():
    """Painted drives whose plates are small, with a wall far off."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stereo, "WIDTH", 160)
        patch.setattr(painted, "WALL", 60.0)
        yield
