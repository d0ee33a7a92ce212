"""The order of the tests of parts: nobody waits for the finished run while there is something else to do."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put a file that needs ``demo_run`` first, which makes it, and the others behind those that do not need it.

    A worker that needs the run before it is finished waits for it, and its core is idle.
    """
    needing = list(dict.fromkeys(item.path for item in items if "demo_run" in getattr(item, "fixturenames", ())))
    items.sort(key=lambda item: 0 if item.path in needing[:1] else 1 + (item.path in needing))
