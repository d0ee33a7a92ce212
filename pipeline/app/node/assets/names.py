"""Names of what clients download, and where they lie in the packed results. Light to import."""

from __future__ import annotations

ALL = "all.zip"


def asset_path(name: str) -> str | None:
    """The path of an asset below a job's ``assets`` folder; None if there is no asset of this name.

    Args:
        name: The name that the client asks for, such as ``all.zip`` or ``orthophoto.tif``.
    """
    return name if name == ALL else None
