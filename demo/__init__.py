"""The demo capture: 40 rendered photos of a house, their ground truth, and their generator."""

from __future__ import annotations

from pathlib import Path

CAPTURE = Path(__file__).parent / "capture"


def capture_path() -> Path:
    """The photos' folder; ``truth.json``, ``gcp_list.txt``, ``rtk.json`` and ``surface.ply`` lie beside it."""
    return CAPTURE / "photos"
