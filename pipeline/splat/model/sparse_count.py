"""The number of initial Gaussians from sparse points, which come first in the file: a header comment."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NAME = "SparsePoints"


def sparse_comment(count: int) -> str:
    """The header comment with the count.

    Args:
        count: Number of Gaussians from sparse points.
    """
    return f"{_NAME}: {count}"


def sparse_count(comments: Sequence[str], gaussians: int) -> int:
    """Read the count from the comments; without one, all Gaussians count, as they cannot be told apart.

    Args:
        comments: Comments of a splat's header.
        gaussians: Number of Gaussians in the file.
    """
    matches = [re.fullmatch(rf"{_NAME}: ([0-9]{{1,15}})", comment, re.ASCII) for comment in comments]
    counts = [int(match[1]) for match in matches if match is not None]
    return min(counts[0], gaussians) if counts else gaussians
