"""The order of the tests of parts, and commands that nobody asks for a whole report."""

from collections.abc import Iterator

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put a file that needs ``demo_run`` first, which makes it, and the others behind those that do not need it.

    A worker that needs the run before it is finished waits for it, and its core is idle.
    """
    needing = list(dict.fromkeys(item.path for item in items if "demo_run" in getattr(item, "fixturenames", ())))
    items.sort(key=lambda item: 0 if item.path in needing[:1] else 1 + (item.path in needing))


@pytest.fixture
def plain_reports() -> Iterator[None]:
    """Let the commands of a test write their reports without pictures: others look at these."""
    import command  # not before arrays are checked where they are used

    with command.plain_reports():
        yield
