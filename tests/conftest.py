"""Shared by all tests: where the real photos are, and the demo capture."""

from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--captures", default=None, help="Folder of real captures, for the tests marked captures.")


@pytest.fixture(scope="session")
def captures(request: pytest.FixtureRequest) -> Path:
    """The folder of real captures."""
    folder = request.config.getoption("--captures")
    assert folder, "give the folder of real captures with --captures"
    return Path(folder)
