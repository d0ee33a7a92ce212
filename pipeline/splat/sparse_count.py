"""How many of a start's Gaussians are those of sparse points: a line in its file's header, for they come first."""

from __future__ import annotations

import re
from collections.abc import Sequence

_NAME = "SparsePoints"


def sparse_comment(count: int) -> str:
    """The header comment that tells it.

    Args:
        count: Gaussians of sparse points.
    """
    return f"{_NAME}: {count}"


def sparse_count(comments: Sequence[str], gaussians: int) -> int:
    """How many the comments tell; all of them where they tell none: there is no telling them apart.

    Args:
        comments: Of a splat's header.
        gaussians: In the file.
    """
    told = [re.fullmatch(rf"{_NAME}: ([0-9]{{1,15}})", comment, re.ASCII) for comment in comments]
    counts = [int(match[1]) for match in told if match is not None]
    return min(counts[0], gaussians) if counts else gaussians
