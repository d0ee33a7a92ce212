"""An issue of a capture: something about its photos that may be wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class CaptureIssue:
    """Something that may be wrong with a capture: a warning of a run, or a finding of the preflight.

    Attributes:
        code: What it is, for programs.
        message: One sentence.
        hint: What to do about it.
        photos: Names of the photos concerned; empty if it concerns the whole capture.
        severity: A ``note`` costs neither photos nor accuracy.
    """

    code: str
    message: str
    hint: str = ""
    photos: tuple[str, ...] = ()
    severity: Literal["warning", "note"] = "warning"
