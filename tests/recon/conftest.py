import pytest
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
