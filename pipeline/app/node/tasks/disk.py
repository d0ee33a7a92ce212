"""Free space of the node's disk."""

from __future__ import annotations

import shutil
from pathlib import Path


def free_bytes(folder: Path) -> int:
    """Bytes that can still be written below a folder; 0 if that cannot be told."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0
