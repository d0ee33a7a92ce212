"""What the command line adds to a run: abbreviated options, and statuses as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.runs.line import StageStatus


def with_budgets(assignments: Sequence[str] | None, time_budget: str | None, max_memory: str | None) -> list[str]:
    """Append ``--time-budget`` and ``--max-memory`` as the assignments they abbreviate."""
    from splatpipe.pipeline.engine.quantities import parse_bytes, parse_duration

    budgets = []
    if time_budget is not None:
        budgets.append(f"train.time_budget_s={parse_duration(time_budget, '--time-budget')!r}")
    if max_memory is not None:
        budgets.append(f"train.max_memory_bytes={parse_bytes(max_memory, '--max-memory')}")
    return [*budgets, *(assignments or ())]


def with_boundary(assignments: Sequence[str] | None, boundary: str | None) -> list[str]:
    """Append ``--boundary`` as the assignment it abbreviates."""
    return [*([] if boundary is None else [f"georef.boundary={boundary}"]), *(assignments or ())]


def status_as_json(status: StageStatus) -> dict[str, Any]:
    """The status of a stage and of its shards, for ``status --json``."""
    from splatpipe.pipeline.engine.runs.needs import used_and_forecast

    artifact = status.artifact
    return {
        "name": status.stage.name,
        "state": status.state,
        "reason": status.reason,
        "seconds": artifact.manifest["seconds"] if artifact else None,
        "summary": artifact.summary if artifact else None,
        **(used_and_forecast(artifact.manifest) if artifact else {}),
        **({"shards": [status_as_json(shard) for shard in status.shards]} if status.shards else {}),
    }
