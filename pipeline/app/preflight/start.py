"""The quick checks at the start of every run: errors that would end it only hours later, and the forecast."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from splatpipe.pipeline.engine.runs.session import Request
    from splatpipe.pipeline.train.blocks.cells.division import Division
    from splatpipe.stages.forecast.training import CaptureSize, Training
    from splatpipe.stages.options import LineConfig


COMMAND_BYTES = 80_000_000  # memory of the command that waits for the stage's process; measured 66 MB


def require_readable(request: Request) -> None:
    """Read the survey files as georef will, and a film's index as ingest will, to report errors now.

    Raises:
        SplatpipeError: if the GCP file, the scale bars or the boundary cannot be read, or a film is truncated or none.
    """
    from splatpipe.pipeline.engine.runs.source import is_film, open_source

    source = open_source(request.photos, request.out, request.stages, request.config)
    if is_film(source.folder):
        _read_film(source.folder)
    readers = {
        "source.control": _read_control,
        "source.scale_bars": _read_scale_bars,
        "source.boundary": _read_boundary,
    }
    for part, read in readers.items():
        path = source.part_path(part) if part in source.named else None
        if path is not None and path.is_file():
            read(path)


def memory_limit(config: LineConfig, device: str) -> int:
    """The user's limit on this machine's memory, bytes; 0 without one, or if it is for a CUDA device's."""
    limit = config.train.max_memory_bytes
    return 0 if limit and _on_cuda(device) else limit


def require_memory(request: Request, until: str | None = None, *, here: bool = True) -> None:
    """Check that training fits the memory limit; a CUDA device's memory is known only when training starts.

    Args:
        request: The run.
        until: The last stage; None for the whole pipeline.
        here: Whether training will run on this machine, and in this container or job, whose limit counts, too.

    Raises:
        MachineError: if the training libraries and the smallest model need more.
    """
    from splatpipe.pipeline.engine.errors import MachineError
    from splatpipe.pipeline.engine.machine import memory_limit_bytes
    from splatpipe.stages.forecast.training import min_memory_bytes

    config = cast("LineConfig", request.config)
    limit, least = config.train.max_memory_bytes, min_memory_bytes(config.train)
    if 0 < limit < least and not _on_cuda(request.machine.device):
        raise MachineError(
            f"Training does not fit in {limit / 1e9:.2f} GB: the libraries alone take most of {least / 1e9:.2f} GB.",
            hint=f"Give --max-memory at least {-(-least // 1_000_000)}M.",
        )
    machine, least = memory_limit_bytes() if here else 0, least + COMMAND_BYTES
    if 0 < machine < least and _will_train(request, until) and not _on_cuda(request.machine.device):
        raise MachineError(
            f"Training does not fit in this machine's or container's {machine / 1e9:.2f} GB of memory: the libraries "
            f"alone take most of {least / 1e9:.2f} GB.",
            hint=f"Give the container at least {-(-least // (1 << 20))}m (docker run --memory), or use --until sparse.",
        )


def _will_train(request: Request, until: str | None) -> bool:
    """Whether training is among the stages that a run has yet to do."""
    from splatpipe.pipeline.engine.runs.line import line_status
    from splatpipe.pipeline.engine.runs.session import status_of

    names = [stage.name for stage in request.stages]
    if "train" not in names or (until in names and names.index(until) < names.index("blocks")):
        return False
    if not (request.out / "stages").is_dir():
        return True
    return not any(status.stage.name == "train" and status.artifact for status in line_status(*status_of(request)))


def forecast_text(request: Request) -> str:
    """The forecast for the whole pipeline on this machine, in a sentence; empty if the capture's size is unknown."""
    from splatpipe.pipeline.app.report.facts.wording import roughly
    from splatpipe.pipeline.engine.machine import available_memory_bytes
    from splatpipe.pipeline.engine.runs.needs import whole
    from splatpipe.stages.forecast.needs import RunForecast, machine_speed

    config, threads, size = cast("LineConfig", request.config), request.machine.threads, _size(request)
    if size is None or _on_cuda(request.machine.device):
        return ""
    run = RunForecast.of(size, config, threads, available_memory_bytes())
    training, needs = run.training, run.needs(machine_speed())
    need = whole(needs)
    seconds = sum(each.seconds(threads) for each in needs.values())
    text = f"{size.photos:,} photos of {size.megapixels:.1f} megapixels take about {roughly(seconds)}, "
    text += (
        f"{need.memory_bytes / 1e9:.1f} GB of memory and {(need.disk_bytes + need.scratch_bytes) / 1e9:.1f} GB of disk"
    )
    if config.train.time_budget_s:
        return f"{text}."
    seconds = sum(needs[stage].seconds(threads) for stage in ("blocks", "train"))
    text += f": training {roughly(seconds)}, {training.iterations:,} iterations"
    most = training.most_gaussians
    if training.division is not None:
        text += f", {blocks_text(training, training.division)}"
    elif config.train.max_memory_bytes and most < training.grown:
        text += f"; the memory holds {round(most, -3):,.0f} Gaussians, and the photos would support more"
    return f"{text}."


def shortage_text(request: Request, until: str | None = None) -> str:
    """Which stages are forecast to exceed the memory limit on a single thread, in a sentence; empty if none does.

    Args:
        request: The run. Its training keeps to the limit in any case.
        until: The last stage; None for the whole pipeline.
    """
    from splatpipe.pipeline.engine.machine import memory_limit_bytes
    from splatpipe.stages.forecast.needs import TRAINING, RunForecast

    limit, size = memory_limit_bytes(request.machine.memory_bytes), _size(request)
    if size is None or not limit:
        return ""
    needs = RunForecast.of(size, cast("LineConfig", request.config), 1, limit).needs(1.0)
    names = [stage.name for stage in request.stages]
    names = names[: names.index(until) + 1] if until in names else names
    short = [name for name in names if name not in TRAINING and name in needs and needs[name].memory_bytes > limit]
    if not short:
        return ""
    most = [f"{name} up to {needs[name].memory_bytes / 1e9:.1f} GB" for name in short]
    text = f"Memory may not suffice: {', '.join(most)} by the forecast, and the limit is {limit / 1e9:.1f} GB"
    return f"{text}; raise it (--max-memory, the container's limit), or give fewer or smaller photos."


def _size(request: Request) -> CaptureSize | None:
    """The capture's size; None if it is unknown, or the photos come with a model, whose mapping has no forecast."""
    from splatpipe.pipeline.app.preflight.sizing import size_of
    from splatpipe.pipeline.engine.runs.source import open_source

    source = open_source(request.photos, request.out, request.stages, request.config)
    size = size_of(source)
    return None if source.model is not None or size.photos * size.megapixels == 0.0 else size


def blocks_text(training: Training, division: Division) -> str:
    """How the scene is divided into blocks, and what a block needs, in words."""
    text = f"in {division.blocks} blocks of {division.need.trained:,} Gaussians and "
    text += f"{division.memory_bytes / 1e9:.1f} GB of memory at most"
    trained = round(training.block_gaussians(division), -3)
    return f"{text}, about {trained:,.0f} Gaussians and {training.photos_per_block:.0f} photos each"


def _on_cuda(device: str) -> bool:
    """Whether training will run on a CUDA device, by the device that was asked for."""
    from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason

    return device != "cpu" and unavailable_reason() is None


def _read_film(path: Path) -> None:
    from splatpipe.pipeline.photos.video.boxes import read_container

    read_container(path)


def _read_control(path: Path) -> None:
    from splatpipe.pipeline.survey.files.control_file import read_control_file

    read_control_file(path)


def _read_scale_bars(path: Path) -> None:
    from splatpipe.pipeline.survey.files.scale_bars import read_scale_bars

    read_scale_bars(path)


def _read_boundary(path: Path) -> None:
    from splatpipe.pipeline.survey.files.boundary_file import read_boundary

    read_boundary(path)
