"""A quick run of the whole pipeline on a dozen photos, for groups that continue it, kill it or compare with it."""

import shutil
from pathlib import Path

import pytest
from command import answered, ran
from quick_line import QUICK, STAGES, sets

from splatpipe.demo import capture_path


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last dozen photos of the demo capture: a strip from above and the end of an orbit."""
    folder = tmp_path_factory.mktemp("capture") / "photos of a house"
    folder.mkdir()
    for photo in sorted(capture_path().glob("*.JPG"))[-12:]:
        shutil.copy(photo, folder)
    return folder


@pytest.fixture(scope="session")
def undisturbed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbed. To be read only."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    assert ran(answered("run", photos, out, *sets(*QUICK), "--threads", 2)) == STAGES
    return out


@pytest.fixture
def copy_of_run(undisturbed: Path, tmp_path: Path) -> Path:
    """A finished run that a test may change."""
    return shutil.copytree(undisturbed, tmp_path / "out")
