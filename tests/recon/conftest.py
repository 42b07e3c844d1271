import pytest
from made_colmap import pictures_along, write_colmap
from made_drive import write_drive


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
