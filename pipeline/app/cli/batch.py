"""`splatpipe batch`: many captures, unattended."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from splatpipe.pipeline.app.library.requests import check_stage, overrides, request_of
from splatpipe.pipeline.app.terminal.parameters import (
    ConfigOption,
    JsonOption,
    MachineOptions,
    NotifyOption,
    OutArgument,
    PresetOption,
    SetOption,
    UntilOption,
)
from splatpipe.pipeline.app.terminal.summary import print_json
from splatpipe.pipeline.engine.errors import EXIT_INPUT, exit_code

if TYPE_CHECKING:
    from splatpipe.pipeline.app.batch.jobs.snakemake_process import Profile
    from splatpipe.pipeline.app.batch.pages.state import BatchState
    from splatpipe.pipeline.app.batch.planning import Settings

RETRIES = 2  # a training that ran out of memory twice gets three times as much on the last try


def batch(
    captures: Annotated[
        Path, typer.Argument(help="Folder of capture folders, or a list of captures: TOML or CSV.", show_default=False)
    ],
    out: OutArgument,
    preset: PresetOption = "standard",
    config: ConfigOption = None,
    assignments: SetOption = None,
    until: UntilOption = None,
    *,
    machine: MachineOptions,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Snakemake profile, to run the jobs elsewhere: Slurm, Kubernetes."),
    ] = None,
    retries: Annotated[
        int, typer.Option(min=0, max=10, help="How many times a stage that crashed is restarted.")
    ] = RETRIES,
    retry_failed: Annotated[
        bool,
        typer.Option(
            "--retry-failed", help="Retry captures that failed because of their photos or options, even if unchanged."
        ),
    ] = False,
    notify: NotifyOption = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List what would run for each capture, and count the jobs.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run many captures unattended: finished results are reused, and a failed capture does not stop the others."""
    from splatpipe.pipeline.app.batch.capture_list import with_files_from
    from splatpipe.pipeline.app.batch.jobs.snakemake_process import open_profile, require_snakemake
    from splatpipe.pipeline.app.batch.planning import Settings
    from splatpipe.pipeline.app.notice import check_command
    from splatpipe.pipeline.engine.config import load_preset

    state: BatchState | None = None
    code = 0
    try:
        load_preset(preset)
        if until:
            check_stage(until)
        if notify is not None:
            check_command(notify)
        where = open_profile(profile)
        require_snakemake(where)
        tables = tuple(with_files_from(Path.cwd(), table) for table in overrides(config, assignments, None).tables)
        if where.local:  # problems of the machine or the options are reported now
            request_of(captures, out, overrides(config, assignments, None).resolve(load_preset(preset)), machine.device)
        gpu = _uses_gpu(machine.device, where)
        node_threads, node_memory = where.largest_machine()
        settings = Settings(
            preset=preset,
            tables=tables,
            until=until or "",
            device=machine.device,
            gpu=gpu,
            threads=machine.threads,
            retries=retries,
            retry_failed=retry_failed,
            local=where.local,
            node_threads=node_threads,
            node_memory_bytes=node_memory,
        )
        if dry_run:
            code = _dry_run(captures, out, settings, where)
        else:
            state = _run(captures, out, settings, where, notify or "")
            code = 0 if state.all_succeeded else EXIT_INPUT
    except BaseException as error:
        if as_json and not isinstance(error, typer.Exit):
            _print(out, state, exit_code(error), error)
        raise
    if as_json:
        _print(out, state, code, None)
    if code:
        raise typer.Exit(code)


def _uses_gpu(device: str, profile: Profile) -> bool:
    """Whether to request a GPU; on a cluster only if named explicitly, since without GPUs the job would never start."""
    if device != "auto" or not profile.local:
        return device == "cuda"
    from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason

    return unavailable_reason() is None


def _run(captures: Path, out: Path, settings: Settings, profile: Profile, command: str) -> BatchState:
    from splatpipe.pipeline.app.batch.capture_list import read_captures
    from splatpipe.pipeline.app.batch.driver import (
        Driver,
        Notifications,
        fresh_call,
        lock_folder,
        summary,
        with_unlisted,
    )
    from splatpipe.pipeline.app.batch.pages.publication import PAGE_FILE
    from splatpipe.pipeline.app.batch.planning import make_plan
    from splatpipe.pipeline.app.terminal.console import print_line

    listed = read_captures(captures, out)
    with lock_folder(out.resolve()) as lock:
        call = fresh_call(out)
        call.write_plan(with_unlisted(make_plan(listed, call, settings)))
        state = Driver(call, profile, Notifications(print_line, command)).run(lock)
    print_line(f"{summary(state.captures)}. {out / PAGE_FILE}")
    return state


def _dry_run(captures: Path, out: Path, settings: Settings, profile: Profile) -> int:
    from splatpipe.pipeline.app.batch.capture_list import read_captures
    from splatpipe.pipeline.app.batch.driver import check_folder, dry_run, fresh_call
    from splatpipe.pipeline.app.batch.planning import make_plan

    listed = read_captures(captures, out)
    check_folder(out)
    call = fresh_call(out, "dry-run")
    try:
        call.write_plan(make_plan(listed, call, settings))
        return dry_run(call, profile)
    finally:
        shutil.rmtree(call.folder, ignore_errors=True)


def _print(out: Path, state: BatchState | None, code: int, error: BaseException | None) -> None:
    from splatpipe.pipeline.app.batch.pages.state import as_json

    facts: dict[str, Any] = {} if state is None else as_json(state)
    trouble = None if error is None else {"message": str(error), "hint": getattr(error, "hint", "")}
    print_json({**facts, "out": str(out), "exit_code": code, "error": trouble})
