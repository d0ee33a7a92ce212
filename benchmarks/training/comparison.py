"""Compare variants with a base over captures and seeds: means, and paired differences with their standard error."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence

from tables import Row

BASE = "base"

# Heading, key of the figure, and its format. A figure that no run has is shown as "-".
MEASURES = {
    "PSNR dB": ("psnr", ".2f"),
    "PSNR cc": ("psnr_cc", ".2f"),
    "SSIM": ("ssim", ".4f"),
    "best − end": ("below_best", ".2f"),
    "veil": ("floaters.veil.mean", ".5f"),
    "free space": ("floaters.free_space_opacity", ".6f"),
    "depth off": ("floaters.depth_disagreement.median", ".5f"),
    "loss": ("loss", ".4f"),
    "Gaussians": ("gaussians", ",.0f"),
    "train s": ("train_seconds", ".1f"),
    "CPU s": ("cpu_s", ".1f"),
}


def means(rows: Sequence[Row], variants: Sequence[str]) -> list[Row]:
    """Return a capture's table: each variant's mean over the seeds, ± half the range, formatted.

    Args:
        rows: Rows of one capture.
        variants: Variants in the order of the table; those without rows are included.
    """
    table = []
    for variant in variants:
        mine = [row for row in rows if row["variant"] == variant]
        line: Row = {"variant": variant, "runs": len(mine)}
        for heading, (key, how) in MEASURES.items():
            values = _values(mine, key)
            if values:
                line[heading] = format(statistics.fmean(values), how)
            if len(values) > 1:
                line[heading] += f" ± {format(0.5 * (max(values) - min(values)), how)}"
        table.append(line)
    return table


def differences(rows: Sequence[Row], variants: Sequence[str]) -> list[Row]:
    """Return each variant's differences from the base with the same capture and seed, for each figure.

    Args:
        rows: Rows of all runs.
        variants: Variants other than the base.

    Returns:
        A row per variant with, under each figure's key, ``mean`` (over captures, of their means over seeds), ``error``
            (standard error over the pairs; None if there are fewer than two) and ``pairs``.
    """
    base = {(row["capture"], row["seed"]): row for row in rows if row["variant"] == BASE}
    found = []
    for variant in variants:
        line: Row = {"variant": variant}
        for key, _ in MEASURES.values():
            by_capture: dict[str, list[float]] = {}
            for row in rows:
                other = base.get((row["capture"], row["seed"]), {})
                if row["variant"] == variant and row.get(key) is not None and other.get(key) is not None:
                    by_capture.setdefault(row["capture"], []).append(row[key] - other[key])
            if by_capture:
                line[key] = _paired(by_capture)
        found.append(line)
    return found


def _paired(by_capture: Mapping[str, Sequence[float]]) -> Row:
    pairs = [value for values in by_capture.values() for value in values]
    error = statistics.stdev(pairs) / math.sqrt(len(pairs)) if len(pairs) > 1 else None
    mean = statistics.fmean(statistics.fmean(values) for values in by_capture.values())
    return {"mean": mean, "error": error, "pairs": len(pairs)}


def written(found: Sequence[Row]) -> list[Row]:
    """Format differences, one column per heading: `+0.31 ± 0.05`."""
    table = []
    for line in found:
        text: Row = {"variant": line["variant"]}
        for heading, (key, how) in MEASURES.items():
            paired = line.get(key)
            if paired is not None:
                text["pairs"] = max(paired["pairs"], text.get("pairs", 0))
                text[heading] = format(paired["mean"], f"+{how}")
                text[heading] += "" if paired["error"] is None else f" ± {format(paired['error'], how)}"
        table.append(text)
    return table


def _values(rows: Iterable[Row], key: str) -> list[float]:
    return [row[key] for row in rows if row.get(key) is not None]
