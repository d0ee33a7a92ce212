"""Elapsed times of stages that ran beside others."""

import pytest

from splatpipe.pipeline.app.report.facts.overlap import overlap_s


def manifest(begin: float, end: float, *, ahead: bool = False) -> dict[str, object]:
    return {"finished_s": end, "seconds": end - begin, **({"ahead": True} if ahead else {})}


def test_time_beside_others_is_counted_once() -> None:
    train, clean, dsm = manifest(100.0, 200.0), manifest(205.0, 215.0), manifest(240.0, 250.0)
    depths = manifest(110.0, 230.0, ahead=True)
    assert overlap_s([train, clean, depths, dsm]) == pytest.approx(90.0 + 10.0)
    assert overlap_s([train, depths, manifest(150.0, 220.0)]) == pytest.approx(110.0)  # these two overlap
    assert overlap_s([train, clean]) == 0.0


def test_stages_of_other_machines_that_took_their_turns_are_added_up() -> None:
    """Shards of one stage: their elapsed times are not those of one clock."""
    assert overlap_s([manifest(0.0, 100.0), manifest(50.0, 120.0)]) == 0.0
