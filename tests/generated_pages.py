"""Pages in docs/ that are generated from the code: written by a command, and held by a test."""

import sys
from collections.abc import Mapping
from pathlib import Path


def write(pages: Mapping[Path, str]) -> int:
    """Write pages and say which have changed; return the exit code."""
    for page, now in pages.items():
        before = page.read_text(encoding="utf-8")
        page.write_text(now, encoding="utf-8")
        sys.stdout.write(f"{page.name}: {'as it was' if now == before else 'written'}\n")
    return 0
