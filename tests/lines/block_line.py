"""The pipeline's stages `blocks` and `train` on a given dataset, in a process of their own.

Called as ``block_line.py SCENE OUT SHARD OPTIONS [THREADS]``: makes that shard, or with an empty name runs the
pipeline.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.executor import Executor
from splatpipe.pipeline.engine.runs.job_runner import JobRunner
from splatpipe.pipeline.engine.runs.line import Line
from splatpipe.pipeline.engine.runs.lock import locked, locked_shard
from splatpipe.pipeline.engine.runs.runner import Outcome, Runner
from splatpipe.pipeline.engine.runs.store import Part, open_store
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.stages.line import BLOCKS, TRAIN
from splatpipe.stages.options import LineConfig

GIVEN = {
    "undistort.dataset": "dataset",
    "split.views": "split.json",
    "initialize.splat": "init.ply",
    "georef.boundary": "boundary.json",
}


def make(
    scene: Path,
    out: Path,
    options: Mapping[str, object],
    shard: str = "",
    threads: int = 1,
    until: str | None = None,
    show: Callable[[Event], None] = lambda event: None,
) -> Outcome:
    """Make one shard of `train`, or all of it, and everything before it.

    Args:
        scene: Folder with the inputs.
        out: An OUT.
        options: Options of `blocks` and `train`.
        shard: Its name; empty for all.
        threads: Threads of the worker.
        until: The last stage.
        show: Receives the events.
    """
    store = open_store(out, create=True)
    source = {name: Part(scene / path, path) for name, path in GIVEN.items()}
    line = Line((BLOCKS, TRAIN), resolve(LineConfig, [options]), source, scene)
    hold = locked_shard(out, shard) if shard else locked(out)
    with hold as held:
        executor = Executor(out / "log", tuple(held.descriptors), {"OMP_NUM_THREADS": str(threads)})
        machine = Machine("cpu", threads)
        runner = Runner(JobRunner(line, store, executor, machine, show, dict), lambda config: None)
        try:
            return runner.run_shard("train", int(shard.split(".")[1])) if shard else runner.walk(until=until)
        finally:
            executor.stop()


def show_event(event: Event) -> None:
    """Print when a training is running, then wait for the caller: no shard finishes before it is killed."""
    if event.kind == "progress" and "training" in str(event.data["what"]):
        print(event.stage, event.data["done"], flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    scene, out, shard, given, *threads = sys.argv[1:]
    make(Path(scene), Path(out), json.loads(given), shard, int(threads[0]) if threads else 1, show=show_event)
