"""What to run: options resolved from preset, file and settings, and the request that a run is opened with."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.machine import available_cores

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.runs.session import Request
    from splatpipe.stages.options import LineConfig

SPENT_VARIABLE = "SPLATPIPE_SPENT_S"
IN_TURN_VARIABLE = "SPLATPIPE_IN_TURN"  # set where the machine is shared by plan: a run then has one stage's resources


@dataclass(frozen=True)
class Overrides:
    """Configuration overrides, as tables: later ones take precedence."""

    tables: Sequence[dict[str, Any]]

    def resolve(self, *below: dict[str, Any]) -> LineConfig:
        from splatpipe.pipeline.engine.config import merge, resolve
        from splatpipe.stages.options import LineConfig
        from splatpipe.stages.products import NO_PRODUCTS, PRODUCTS_FROM_BUDGET_S

        train = merge(self.tables).get("train")
        budget = train.get("time_budget_s") if isinstance(train, dict) else None
        if budget:
            below = (*below, {"train": {"max_megapixels": 0.0}})  # a preset's image size fits its own length
            if isinstance(budget, int | float) and budget < PRODUCTS_FROM_BUDGET_S:
                below = (*below, NO_PRODUCTS)
        return resolve(LineConfig, [*below, *self.tables])


def overrides(config: Path | None, assignments: Sequence[str] | None, seed: int | None) -> Overrides:
    from splatpipe.pipeline.engine.config import load_file, parse_set, with_seed
    from splatpipe.stages.options import LineConfig

    tables = [load_file(config)] if config else []
    for table in tables:  # OUT/config.toml contains these two besides the options
        table.pop("photos", None), table.pop("splatpipe", None)
    if seed is not None:
        tables.append(with_seed(LineConfig, seed))
    return Overrides([*tables, *(parse_set(text, LineConfig) for text in assignments or ())])


def request_of(photos: Path, out: Path, config: LineConfig, device: str = "auto", threads: int = 0) -> Request:
    from splatpipe.pipeline.app.preflight.start import memory_limit
    from splatpipe.pipeline.engine.runs.session import Request
    from splatpipe.pipeline.engine.runs.source import with_absolute_files
    from splatpipe.pipeline.engine.stage import Machine
    from splatpipe.stages.forecast.needs import Forecaster
    from splatpipe.stages.line import AHEAD, LINE

    began_s = round(time.monotonic() - spent_s(), 3)
    check_machine(device, threads)
    if device == "cuda":  # reported now, not when training begins; `auto` falls back to the CPU if CUDA does not work
        from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason

        if unfit := config.train.unfit_for_cuda():
            raise UsageError(unfit, hint="Omit --device, or give --device cpu.")
        if missing := unavailable_reason():
            raise missing.error()
    if os.environ.get("SPLATPIPE_ISA"):  # an invalid one is reported now, not when training begins
        import splatpipe.pipeline.raster.isa  # noqa: F401
    machine = Machine(device, threads or available_cores(), began_s, memory_limit(config, device))
    forecast_needs = Forecaster(config, machine.threads)
    # Within a time budget, what ran beside training would decide how far it comes.
    in_turn = config.train.time_budget_s or IN_TURN_VARIABLE in os.environ
    ahead = {} if in_turn else AHEAD
    return Request(LINE, with_absolute_files(config, LINE), photos, out, machine, forecast_needs, ahead)


def check_machine(device: str, threads: int) -> None:
    if device not in ("auto", "cpu", "cuda"):
        raise UsageError(f'There is no device "{device}".', hint="Choose auto, cpu or cuda.")
    if threads < 0:
        raise UsageError(f"{threads} threads are not possible.", hint="Give a number of threads, or 0 for all cores.")


def spent_s() -> float:
    """Seconds that earlier commands spent on the same capture, which count towards a time budget."""
    try:
        return max(0.0, float(os.environ.get(SPENT_VARIABLE, "0")))
    except ValueError:
        return 0.0


def existing_request(
    out: Path, tables: Sequence[dict[str, Any]] = (), device: str = "auto", threads: int = 0
) -> Request:
    """The request that runs OUT again with the given overrides."""
    from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
    from splatpipe.stages.line import LINE
    from splatpipe.stages.options import LineConfig

    photos, config = open_run_folder(out, LINE).config(LineConfig, *tables)
    return request_of(photos, out, config, device, threads)


def check_stage(name: str) -> None:
    from splatpipe.stages.line import LINE

    names = [entry.name for entry in LINE]
    if name not in names:
        raise UsageError(f'There is no stage "{name}".', hint=f"The stages are: {', '.join(names)}.")


def stages_to_rerun(rerun: Iterable[str], rerun_from: str | None, until: str | None) -> frozenset[str]:
    from splatpipe.stages.line import LINE

    if isinstance(rerun, str):
        raise UsageError(f'"{rerun}" is a text, not several stages.', hint=f'Give a list: ["{rerun}"].')
    for name in [*rerun, *filter(None, (rerun_from, until))]:
        check_stage(name)
    names = [entry.name for entry in LINE]
    return frozenset([*rerun, *(names[names.index(rerun_from) :] if rerun_from else [])])
