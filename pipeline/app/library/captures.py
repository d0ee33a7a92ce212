"""Runs of the pipeline from Python: the functions behind ``splatpipe run`` and ``splatpipe stage``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatpipe.pipeline.app.library.commands import Watch, run_line, run_one_stage
from splatpipe.pipeline.app.library.requests import (
    Overrides,
    check_stage,
    existing_request,
    overrides,
    request_of,
    stages_to_rerun,
)
from splatpipe.pipeline.app.library.run import Run, open_run
from splatpipe.pipeline.app.library.user_errors import user_errors
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.events import Event

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.config import Table

Device = Literal["auto", "cpu", "cuda"]


class CallbackWatch(Watch):
    """Passes events on to a function.

    Args:
        on_event: Called with each event; None to discard them.

    Attributes:
        raised: What the function has raised.
    """

    def __init__(self, on_event: Callable[[Event], object] | None) -> None:
        super().__init__()
        self._on_event = on_event
        self.raised: Exception | None = None

    def event(self, event: Event) -> None:
        """Pass an event on."""
        if self._on_event is not None:
            try:
                self._on_event(event)
            except Exception as error:
                self.raised = error
                raise

    @contextmanager
    def errors(self) -> Iterator[None]:
        """As ``user_errors``, but what the function itself has raised stays what it is: it is the caller's."""
        try:
            with user_errors():
                yield
        except SplatpipeError as error:
            if self.raised is None:
                raise
            raise self.raised from error


def run_capture(
    photos: Path | str,
    out: Path | str,
    *,
    preset: str = "standard",
    options: Mapping[str, Any] | None = None,
    config: Path | str | None = None,
    until: str | None = None,
    rerun: Iterable[str] = (),
    rerun_from: str | None = None,
    seed: int | None = None,
    device: Device = "auto",
    threads: int = 0,
    wait: bool = False,
    on_event: Callable[[Event], object] | None = None,
) -> Run:
    """Turn a folder of photos into a Gaussian splat; valid results of earlier runs are reused.

    As ``splatpipe run``: a stopped run resumes when it is called again, and the results are the same to the bit. The
    work is done in a process of its own, which ends with this one.

    Args:
        photos: Folder of photos, or a COLMAP folder with ``images/`` and ``sparse/0``, or a film.
        out: Folder for the results; made if it is missing.
        preset: ``preview``, ``standard`` or ``high``.
        options: Options by dotted name, e.g. ``{"train.iterations": 500}``; they override preset and file. See
            docs/options.md.
        config: TOML file of options, which override the preset's.
        until: The last stage to run; None for all.
        rerun: Stages to run again even if their results are valid.
        rerun_from: Run this stage and all later ones again.
        seed: Seed of all random numbers; None for the options' own.
        device: ``auto``, ``cpu`` or ``cuda``.
        threads: Threads; 0 for all cores. Does not change the result.
        wait: If another splatpipe is working in OUT, wait for it instead of failing.
        on_event: Called with each event: stages that start and end, progress, notes, warnings; one call at a time, but
            those of a stage that runs beside another come from a second thread. If it raises an exception, the run
            stops, and can be resumed.

    Returns:
        The run.

    Raises:
        SplatpipeError: if an option is wrong, the photos or OUT cannot be used, or a stage failed; finished work is
            kept.
    """
    from splatpipe.pipeline.engine.config import load_preset

    photos, out = Path(photos).expanduser(), Path(out).expanduser()
    watch = CallbackWatch(on_event)
    with watch.errors():
        given = overrides(None if config is None else Path(config).expanduser(), None, seed)
        resolved = Overrides([*given.tables, *_tables(options)]).resolve(load_preset(preset))
        again = stages_to_rerun(rerun, rerun_from, until)
        request = request_of(photos, out, resolved, device, threads)
        run_line(request, watch, until=until, rerun=again, wait=wait)
        return open_run(out, device=device, threads=threads)


def run_stage(
    name: str,
    out: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    shard: int | None = None,
    device: Device = "auto",
    threads: int = 0,
    wait: bool = False,
    on_event: Callable[[Event], object] | None = None,
) -> Run:
    """Run one stage of an existing OUT again, or one of its shards; no other stage except the one that divides it.

    As ``splatpipe stage``.

    Args:
        name: The stage.
        out: Folder of the run.
        options: Options by dotted name; they override the run's.
        shard: Run only this shard, from 1; other processes may run others at the same time.
        device: As in ``run_capture``.
        threads: Likewise.
        wait: Likewise.
        on_event: Likewise.

    Returns:
        The run.

    Raises:
        SplatpipeError: if there is no such run or stage, an option is wrong, or the stage failed.
    """
    out = Path(out).expanduser()
    watch = CallbackWatch(on_event)
    with watch.errors():
        check_stage(name)
        if shard is not None and options:
            raise UsageError("All shards of a stage have the same options.", hint="Omit either options or shard.")
        request = existing_request(out, _tables(options), device, threads)
        run_one_stage(name, request, watch, shard=shard, wait=wait)
        return open_run(out, device=device, threads=threads)


def _tables(options: Mapping[str, Any] | None) -> list[Table]:
    from splatpipe.pipeline.engine.config import table_of

    return [table_of(name, value) for name, value in (options or {}).items()]
