"""Forecasts a job in a process of its own, which may load what the node must not.

    python -m splatpipe.pipeline.app.node.tasks.forecast PHOTOS OUT THREADS OPTIONS

Prints one JSON object: the fields of ``Forecast``, or ``error`` with what is wrong with the photos or options.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError

MODULE = "splatpipe.pipeline.app.node.tasks.forecast"


def main() -> None:
    """Print the forecast for the command line's arguments."""
    photos, out, threads, options = sys.argv[1:]
    try:
        found = forecast(Path(photos), Path(out), int(threads), json.loads(options))
    except SplatpipeError as error:
        found = {"error": f"{error.message} {error.hint}".strip(), "lasting": not isinstance(error, MachineError)}
    print(json.dumps(found))  # noqa: T201


def forecast(photos: Path, out: Path, threads: int, options: dict[str, Any]) -> dict[str, Any]:
    """The forecast of a run, as JSON.

    Args:
        photos: Its folder of photos, or film.
        out: Its OUT.
        threads: Its threads.
        options: ``preset``, ``tables`` and ``until`` as in ``RunOptions``.

    Raises:
        SplatpipeError: if the photos or the files beside them cannot be used.
    """
    from splatpipe.pipeline.app.library.requests import Overrides, request_of
    from splatpipe.pipeline.app.preflight.sizing import size_of
    from splatpipe.pipeline.app.preflight.start import require_memory, require_readable
    from splatpipe.pipeline.engine.config import load_preset
    from splatpipe.pipeline.engine.machine import available_memory_bytes
    from splatpipe.pipeline.engine.runs.line import Line
    from splatpipe.pipeline.engine.runs.needs import whole
    from splatpipe.pipeline.engine.runs.source import open_source
    from splatpipe.pipeline.engine.runs.store import Part
    from splatpipe.stages.forecast.needs import RunForecast, machine_speed

    until = options["until"] or None
    config = Overrides([options["tables"]]).resolve(load_preset(options["preset"]))
    request = request_of(photos, out, config, threads=threads)
    source = open_source(request.photos, request.out, request.stages, config)
    require_readable(request)
    require_memory(request, until)
    size = size_of(source)
    if size.photos == 0:
        raise SplatpipeError("There are no photos in the upload.", hint="Send JPEG, PNG or TIFF photos, or a film.")
    line = Line(request.stages, config, {name: Part(source.folder, "") for name in source.part_files}, source.folder)
    names = [stage.name for stage in line.needed(until)]
    needs = RunForecast.of(size, config, threads, available_memory_bytes()).needs(machine_speed())
    needs = {name: need for name, need in needs.items() if name in names}
    need = whole(needs)
    weights = {name: round(each.seconds(threads), 3) for name, each in needs.items()}
    return {
        "photos": size.photos,
        "memory_bytes": need.memory_bytes,
        "seconds": round(sum(weights.values()), 3),
        "disk_bytes": need.disk_bytes + need.scratch_bytes,
        "weights": weights,
    }


if __name__ == "__main__":
    main()
