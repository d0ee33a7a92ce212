"""Forecast and train a site of a thousand photos: ``large_site OUT WORK``.

OUT is a trained run; its photos (linked), cameras, points and splat are repeated on a grid in plan until there are
``--photos``. The number of blocks and their cost are forecast first. Then the site is partitioned (with OUT's splat,
thinned, in place of a coarse pass, which is not run), and the central and the outermost block are actually trained,
each in its own process: peak memory, disk and CPU time, forecast against measured.

A quick look: ``--photos 80 --max-memory 900M --gaussians 60000 --set train.iterations=600``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from opened_run import open_run
from tables import Row, print_table
from tiled_site import Tiling, middle_and_edge, write_coarse, write_site

from splatpipe.pipeline.app.preflight.start import blocks_text
from splatpipe.pipeline.engine.config import load_preset, parse_set, resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.quantities import parse_bytes
from splatpipe.pipeline.engine.runs.executor import Executor
from splatpipe.pipeline.engine.runs.needs import Need, whole
from splatpipe.pipeline.engine.runs.worker import Task
from splatpipe.pipeline.engine.stage import Inputs, Machine, Shard
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.train.blocks.cells.site_plan import SitePlan
from splatpipe.pipeline.train.blocks.layout import COARSE, PROSPECTS, lay_out
from splatpipe.stages.forecast.needs import RunForecast, machine_speed
from splatpipe.stages.forecast.training import MEGA, CaptureSize
from splatpipe.stages.line import TRAIN
from splatpipe.stages.options import LineConfig

POLL_S = 0.5
COLUMNS = {
    "block": "block:",
    "photos": "photos:,",
    "iterations": "iterations:,",
    "Gaussians": "gaussians:,",
    "memory forecast MB": "memory_forecast:MB",
    "measured": "memory:MB",
    "ratio": "memory_ratio:.2f",
    "disk forecast MB": "disk_forecast:MB",
    "measured ": "disk:MB",
    "ratio ": "disk_ratio:.2f",
    "CPU s forecast": "cpu_forecast:.0f",
    "measured  ": "cpu:.0f",
    "ratio  ": "cpu_ratio:.2f",
}


class WarningReporter:
    """A reporter that passes on only notes and warnings."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        """Discard progress."""

    def metric(self, name: str, value: float, step: int | None = None) -> None:
        """Discard metrics."""

    def note(self, message: str) -> None:
        print(f"  {message}", flush=True)

    def warning(self, message: str, hint: str = "") -> None:
        print(f"  ! {message} {hint}", flush=True)


class DiskUse:
    """Peak disk use of a folder and of the unlinked files of this process's children, sampled.

    Args:
        folder: Folder that they work in.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._over = folder, threading.Event()
        self.most = 0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Sample while the context lasts."""
        thread = threading.Thread(target=self._watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()

    def _watch(self) -> None:
        while not self._over.wait(POLL_S):
            self.most = max(self.most, _named_bytes(self._folder) + _unnamed_bytes(self._folder))


def _named_bytes(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            continue
    return total


def _unnamed_bytes(folder: Path) -> int:
    """Return the size of unlinked files in a folder that children have open: decoded photos."""
    total = 0
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(status.read_text().rpartition(")")[2].split()[1]) != os.getpid():
                continue
            seen = set()
            for link in (status.parent / "fd").iterdir():
                found = link.stat()
                if (
                    found.st_nlink == 0
                    and str(link.readlink()).startswith(str(folder.resolve()))
                    and found.st_ino not in seen
                ):
                    seen.add(found.st_ino)
                    total += found.st_blocks * 512
        except (OSError, ValueError, IndexError):
            continue
    return total


def trained(number: int, site: SitePlan, parts: dict[str, Path], config: LineConfig, work: Path, threads: int) -> Row:
    """Train one block in a process of its own, and return what that took."""
    out = work / f"train.{number}"
    out.mkdir(exist_ok=True)
    task = Task(
        stage=f"train.{number}",
        entry="splatpipe.stages.train:run_block",
        config_type=f"{TRAIN.config.__module__}:{TRAIN.config.__qualname__}",
        config=config.train.model_dump(mode="json"),
        parts={name: str(path) for name, path in parts.items()},
        photos_dir=str(work),
        settings={},
        summaries={},
        machine=asdict(Machine("cpu", threads)),
        out=str(out),
        shard=asdict(Shard(number, len(site.blocks))),
    )
    executor, disk, report = (
        Executor(work / "log", (), {"OMP_NUM_THREADS": str(threads)}),
        DiskUse(out),
        WarningReporter(),
    )

    def show(event: Event) -> None:
        if event.kind in ("note", "warning"):
            getattr(report, event.kind)(event.data["message"])

    try:
        with disk.watched():
            result = executor.run(task, show)
    finally:
        executor.stop()
    return {"memory": result["peak_memory_bytes"], "cpu": result["cpu_seconds"], "disk": disk.most} | {
        "summary": result["summary"]
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run that was trained")
    options.add_argument("work", type=Path, help="folder that the site is laid out in")
    options.add_argument("--photos", type=int, default=1000)
    options.add_argument("--gaussians", type=int, default=4_000_000, help="train.max_gaussians")
    options.add_argument("--max-memory", default="1.5G")
    options.add_argument("--preset", default="standard")
    options.add_argument("--set", nargs="*", default=[], metavar="SECTION.OPTION=VALUE")
    options.add_argument("--threads", type=int, default=2)
    options.add_argument("--forecast-only", action="store_true", help="train nothing")
    arguments = options.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    limits = {
        "max_gaussians": arguments.gaussians,
        "max_memory_bytes": parse_bytes(arguments.max_memory, "--max-memory"),
    }
    tables = [load_preset(arguments.preset), {"train": limits}]
    config = resolve(LineConfig, [*tables, *(parse_set(each, LineConfig) for each in arguments.set)])
    run = open_run(arguments.out)
    tiling = Tiling.of(run, arguments.photos)

    sizes = [view.camera.width * view.camera.height for view in run.views]
    size = CaptureSize(tiling.photos, sum(sizes) / len(sizes) / MEGA, positions=True)
    speed = machine_speed()
    whole_run = RunForecast.of(size, config, arguments.threads)
    needs, division = whole_run.needs(speed), whole_run.training.division
    if division is None:
        options.exit(2, "That much memory holds the site in one: lower --max-memory, or raise --gaussians.\n")
    print(
        f"{tiling.photos:,} photos in {len(tiling.offsets)} tiles, {blocks_text(whole_run.training, division)}; "
        f"machine {speed:.2f}"
    )
    _report_whole(needs)
    if arguments.forecast_only:
        return

    began = time.process_time()
    parts = write_site(tiling, arguments.work)
    coarse = arguments.work / COARSE
    write_coarse(tiling, division.coarse_cap, coarse, arguments.threads)
    inputs = Inputs(parts, arguments.work, machine=Machine("cpu", arguments.threads))
    shutil.rmtree(arguments.work / PROSPECTS, ignore_errors=True)
    (arguments.work / PROSPECTS).mkdir()
    site, forecast = lay_out(config.train, inputs, division, arguments.work, WarningReporter())
    (arguments.work / "blocks.json").write_text(site.to_json(), encoding="utf-8")
    print(
        f"{len(load_views(parts['undistort.dataset'])):,} photos laid out and cut: {time.process_time() - began:.0f} s"
    )
    parts |= {"blocks.plan": arguments.work / "blocks.json", "blocks.coarse": coarse}
    parts["blocks.prospects"] = arguments.work / PROSPECTS
    of_blocks = forecast["of_blocks"]
    print(f"photos a block: {of_blocks['photos']}; iterations: {of_blocks['iterations']}")
    print(f"Gaussians that each begins with: {of_blocks['start']}; around it: {of_blocks['frozen']}")
    own = whole_run.needs_of_blocks(of_blocks, speed)
    rows = []
    for place, block in zip(("middle", "edge"), middle_and_edge(site.partition.cells), strict=True):
        took = trained(block + 1, site, parts, config, arguments.work, arguments.threads)
        rows.append(_row(f"{block + 1}, {place}", own[f"train.{block + 1}"], took, of_blocks, block))
        print_table("forecast against measured", rows, COLUMNS)


def _report_whole(needs: dict[str, Need]) -> None:
    blocks, train, all_of_it = needs["blocks"], needs["train"], whole(needs)
    for name, need in (("coarse pass", blocks), ("blocks", train), ("the line", all_of_it)):
        print(
            f"  {name}: {need.memory_bytes / 1e9:.2f} GB of memory, {need.disk_bytes / 1e9:.2f} GB left on the disk, "
            f"{need.scratch_bytes / 1e9:.2f} meanwhile, {need.cpu_seconds / 60.0:.0f} CPU minutes"
        )


def _row(name: str, need: Need, took: Row, of_blocks: dict[str, list[int]], block: int) -> Row:
    disk = need.disk_bytes + need.scratch_bytes
    return {
        "block": name,
        "photos": of_blocks["photos"][block],
        "iterations": took["summary"]["iterations"],
        "gaussians": took["summary"]["gaussians"],
        "memory_forecast": need.memory_bytes,
        "memory": took["memory"],
        "memory_ratio": took["memory"] / need.memory_bytes,
        "disk_forecast": disk,
        "disk": took["disk"],
        "disk_ratio": took["disk"] / disk,
        "cpu_forecast": need.cpu_seconds,
        "cpu": took["cpu"],
        "cpu_ratio": took["cpu"] / need.cpu_seconds,
    }


if __name__ == "__main__":
    main()
