"""How long stages ran beside others: elapsed times of stages are not to be added up there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from splatpipe.pipeline.engine.stage import JSON

Span = tuple[float, float]


def overlap_s(manifests: Iterable[Mapping[str, JSON]]) -> float:
    """Seconds in which stages that ran ahead of their turn had others beside them.

    Args:
        manifests: Manifests of the stages' artifacts, of whatever runs.
    """
    each = list(manifests)
    in_turn = [_span(manifest) for manifest in each if not manifest.get("ahead")]
    return sum(_covered(_span(manifest), in_turn) for manifest in each if manifest.get("ahead"))


def _span(manifest: Mapping[str, JSON]) -> Span:
    """When a stage ran, seconds since the epoch."""
    end_s = float(manifest["finished_s"])
    return end_s - float(manifest["seconds"]), end_s


def _covered(span: Span, others: Iterable[Span]) -> float:
    """Seconds of a span that at least one of the others covers."""
    at, covered = span[0], 0.0
    for begin, end in sorted(others):
        begin, end = max(begin, at), min(end, span[1])
        if end > begin:
            covered, at = covered + end - begin, end
    return covered
