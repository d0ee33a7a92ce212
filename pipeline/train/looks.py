"""What an iteration looks at of its photo: how often it is halved, and how much of that is one window."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Look:
    """A size to train at.

    Attributes:
        level: How often the photo is halved.
        window_pixels: Of the halved photo, that count in an iteration at most; 0 for all of it, however large.
    """

    level: int = 0
    window_pixels: int = 0
