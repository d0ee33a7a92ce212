"""A stage's child processes: they run in parallel, and none survives, whatever ends the stage."""

from __future__ import annotations

from splatpipe.pipeline.engine.runs.children import run_children

CODE = "timeit"  # runs its arguments as statements; the first of them is our process number, which does no harm


def test_they_run_to_completion_and_their_memory_is_reported() -> None:
    calls = []
    peak = run_children([(CODE, "pass"), (CODE, "pass")], lambda: calls.append(1), "idling")
    assert calls and peak > 2 * 4 << 20  # two interpreters


def test_their_memory_is_counted_without_their_parents() -> None:
    held = bytes(1) * (300 << 20)
    held = held.replace(b"\0", b"\1")  # written, so that it is resident
    peak = run_children([(CODE, "pass")], lambda: None, "idling")
    assert peak < len(held) / 2
