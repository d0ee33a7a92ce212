"""Measure times and sizes of every format for a million Gaussians: ``format_speed OUT [--count 1000000]``.

The run's splat is tiled with small differences up to that count. Each format is written, and read, in a process of its
own: CPU seconds of all its threads, and the rise of its peak memory; beside splat-transform where that writes the
format. Required: written in 5 s, SOG in 120; at most 5 % larger; SOG a fifteenth of the PLY.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import torch
from commands import benchmark
from others import READERS, THEIR_AXES, OtherPrograms, ProgramEnd, find_others
from round_trips import MAX_GROWTH, bytes_of, working_folder, written
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, SplatFormat, format_named
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene

ASKED_S = {"sog": 120.0, "streamed-sog": 120.0}
OTHERS_ASKED_S = 5.0
MIN_SHRUNK = {"sog": 15.0}
JITTER = (0.02, 0.02, 0.05, 0.02)  # standard deviations: positions in units, colours, opacity logits, log-scales
SEED = 19

COLUMNS = {
    "format": "format:",
    "bytes": "bytes:,",
    "PLY's": "shrunk:.2f",
    "splat-transform's": "their_bytes:,",
    "to it": "of_theirs:.3f",
    "written in CPU s": "write_s:.2f",
    "splat-transform": "their_s:.2f",
    "memory MB": "write_bytes:MB",
    "read in CPU s": "read_s:.2f",
    "memory MB ": "read_bytes:MB",
    "bars": "bars:",
}


def laid_out(scene: Scene, count: int) -> Scene:
    """Return a splat of ``count`` Gaussians: copies of one side by side, each with its own small differences."""
    found, generator = scene.gaussians, torch.Generator().manual_seed(SEED)
    copies = -(-count // len(found))
    low, high = (torch.quantile(found.means[:: max(1, len(found) // 100_000)], q, dim=0) for q in (0.02, 0.98))
    step, side = (high - low), int(copies**0.5) + 1
    parts = []
    for number in range(copies):
        part = found.first(count - number * len(found))

        def noise(like: torch.Tensor, size: float) -> torch.Tensor:
            return size * torch.randn(like.shape, generator=generator)

        shift = step * torch.tensor([float(number % side), float(number // side), 0.0])
        sh = part.sh.clone()
        sh[:, 0] += noise(sh[:, 0], JITTER[1])
        part = replace(
            part,
            means=part.means + shift + noise(part.means, JITTER[0]),
            sh=sh,
            opacity_logits=part.opacity_logits + noise(part.opacity_logits, JITTER[2]),
            log_scales=part.log_scales + noise(part.log_scales, JITTER[3]),
        )
        parts.append(part)
    return replace(scene, gaussians=Gaussians.concat(parts))


def measured(kind: SplatFormat, source: Path, folder: Path, what: str) -> Row:
    """Return what a process that writes (or reads back) a file took."""
    words = benchmark("format_speed", source, "--task", what, "--formats", kind.name, "--work", folder)
    done = subprocess.run([sys.executable, *words], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SplatpipeError(f"{kind.name} cannot be {what}.")
    found: Row = json.loads(done.stdout.splitlines()[-1])
    return found


def do_task(what: str, kind: SplatFormat, source: Path, folder: Path) -> None:
    """Write or read in this process, and print a line of JSON."""
    scene = read_scene(source) if what == "written" else None
    before = _used()
    path = folder / kind.file
    if scene is not None:
        path = written(scene, kind, folder)
    else:
        kind.read(path)
    after = _used()
    print(json.dumps({"cpu_s": after[0] - before[0], "bytes": after[1] - before[1], "size": bytes_of(path)}))


def _used() -> tuple[float, int]:
    """Return CPU seconds and peak memory of this process and its finished children."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime
    return seconds, 1024 * (own.ru_maxrss + children.ru_maxrss)


def row_of(kind: SplatFormat, source: Path, folder: Path, theirs: tuple[int, ProgramEnd] | None) -> Row:
    """Return a format's row."""
    wrote = measured(kind, source, folder, "written")
    row: Row = {"format": kind.name, "bytes": wrote["size"], "write_s": wrote["cpu_s"], "write_bytes": wrote["bytes"]}
    row["shrunk"] = source.stat().st_size / row["bytes"]
    if kind.reads:
        read = measured(kind, source, folder, "read")
        row |= {"read_s": read["cpu_s"], "read_bytes": read["bytes"]}
    missed = []
    if row["write_s"] > ASKED_S.get(kind.name, OTHERS_ASKED_S):
        missed.append("time")
    if row["shrunk"] < MIN_SHRUNK.get(kind.name, 0.0):
        missed.append("a fifteenth")
    if theirs is not None:
        row |= {"their_bytes": theirs[0], "their_s": theirs[1].cpu_s, "of_theirs": row["bytes"] / theirs[0]}
        if row["of_theirs"] > MAX_GROWTH:
            missed.append("bytes")
    return row | {"bars": f"missed: {', '.join(missed)}" if missed else "met"}


def theirs_of(kind: SplatFormat, scene: Scene, folder: Path, others: OtherPrograms) -> tuple[int, ProgramEnd]:
    """Return the size of splat-transform's file of a splat, and what writing it took."""
    source = folder / "theirs_from.ply"
    write_splat(source, scene.turned(THEIR_AXES).gaussians)
    path, ended = others.write(kind.name, source, folder)
    return bytes_of(path), ended


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="a finished run")
    parser.add_argument("--count", type=int, default=1_000_000, help="Gaussians")
    parser.add_argument("--readers", type=Path, default=READERS, help="where npm ci was run")
    parser.add_argument("--formats", default="", help="names, with commas; all without")
    parser.add_argument("--slow", default="", help="formats that splat-transform is not to write, with commas")
    parser.add_argument("--work", type=Path, help="a folder that keeps the files")
    parser.add_argument("--json", type=Path, help="leaves all figures here, too")
    parser.add_argument("--task", choices=("written", "read"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.task is not None:
        do_task(options.task, format_named(options.formats), options.out, options.work)
        return
    wanted, slow = (set(names.split(",")) - {""} for names in (options.formats, options.slow))
    others, rows = find_others(options.readers), []
    with working_folder(options.work) as folder:
        scene, source = laid_out(read_scene(options.out / "splat.ply"), options.count), folder / "large.ply"
        written(scene, format_named("ply"), folder).rename(source)
        for kind in SPLAT_FORMATS:
            if wanted and kind.name not in wanted:
                continue
            asked = others.writes(kind.name) and kind.name not in slow
            theirs = theirs_of(kind, scene, folder, others) if asked else None
            rows.append(row_of(kind, source, folder, theirs))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print_table(f"{options.count:,} Gaussians of {options.out.name}", rows, COLUMNS)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
