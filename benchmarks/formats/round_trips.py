"""Write every format, read it with our reader and splat-transform, and render it: ``round_trips OUT [OUT …]``.

One table per run: similarity to the original in the held-out views, by our reader, by splat-transform's, and of
splat-transform's own file of the same splat; bytes; displacement of positions, in the run and over a 3 km site.
Required: PLY and model folder identical, GLB 70 dB; SPZ 3, SOG, compressed PLY 38 dB, no more than 0.3 dB below
splat-transform's nor 5 % larger. For times see `format_speed`. Set up once: npm ci --prefix benchmarks/formats/readers.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from captures import CaptureRun, Picture, decibels, likely_frame, open_capture
from others import READERS, THEIR_AXES, OtherPrograms, find_others, sog_iterations
from position_errors import position_row, site_of
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, SplatFormat
from splatpipe.pipeline.splat.formats.files import write_scene
from splatpipe.pipeline.splat.model.scene import Scene

ASKED_DB = {"ply": math.inf, "model": math.inf, "glb": 70.0, "spz": 38.0, "sog": 38.0, "compressed-ply": 38.0}
MAX_LOSS_DB = 0.3  # splat-transform's
MAX_GROWTH = 1.05  # times splat-transform's
SOG_S = 600.0  # CPU seconds for the palette of splat-transform's SOG: on a CPU, its 10 iterations take long
SITE, DESTROYED = "3 km", "would destroy the splat"
LIKE = {"model": "ply"}  # formats that store positions as another one does

COLUMNS = {
    "format": "format:",
    "our reader dB": "ours_db:.2f",
    "axes": "axes:",
    "splat-transform reads dB": "by_them_db:.2f",
    "axes ": "by_them_axes:",
    "its own file dB": "theirs_db:.2f",
    "our reader of it dB": "theirs_by_us_db:.2f",
    "bytes": "bytes:,",
    "to its": "of_theirs:.3f",
    "bars": "bars:",
}
POSITION_COLUMNS = {
    "format": "format:",
    "over": "over:",
    "median step mm": "step_mm:.4f",
    "largest": "largest_step_mm:.4f",
    "median error mm": "median_mm:.4f",
    "largest ": "largest_mm:.4f",
    "in steps": "in_steps:.3f",
    "brought in": "brought_in:,",
    "half a step": "bars:",
}


@dataclass(frozen=True)
class TripFolder:
    """Output folder and third-party readers.

    Attributes:
        folder: Folder for files; splat-transform's output is reused for the same splat.
        others: Third-party programs.
        slow: Formats that splat-transform does not write, to save time.
        sog_s: CPU seconds for the palette of its SOG, which has fewer iterations if they take longer.
    """

    folder: Path
    others: OtherPrograms
    slow: frozenset[str] = field(default_factory=frozenset)
    sog_s: float = SOG_S

    def theirs(self, name: str, scene: Scene) -> Path | None:
        """Return splat-transform's file of a splat; None if it does not write the format."""
        if not self.others.writes(name) or name in self.slow:
            return None
        options: tuple[str, ...] = ()
        if name == "sog":
            iterations = sog_iterations(len(scene.gaussians), self.sog_s)
            if iterations == 0:
                return None
            options = ("-i", str(iterations))
        source = self.folder / "theirs_from.ply"
        write_splat(source, scene.turned(THEIR_AXES).gaussians)
        digest = hashlib.sha256(source.read_bytes()).hexdigest()[:16]
        folder = self.folder / f"theirs-{digest}"
        folder.mkdir(exist_ok=True)
        called = "".join([name, *options, "~"])
        kept = [path for path in folder.iterdir() if path.name.startswith(called)]
        if kept:
            return kept[0]
        path, _ = self.others.write(name, source, self.folder, *options)
        return path.rename(folder / f"{called}{path.name}")


def round_trip(capture: CaptureRun, originals: Sequence[Picture], kind: SplatFormat, work: TripFolder) -> Row:
    """Return a format's row."""
    path = written(capture.scene, kind, work.folder / capture.name)
    row: Row = {"format": kind.name, "bytes": bytes_of(path)}
    missed = []
    if kind.reads:
        read = kind.read(path)
        row |= {"ours_db": decibels(capture.pictures(read), originals), "axes": read.facts.axes}
        if row["ours_db"] < ASKED_DB.get(kind.name, 0.0):
            missed.append(f"{ASKED_DB[kind.name]:.0f} dB")
        if ASKED_DB.get(kind.name) == math.inf and not same(read, capture.scene):
            missed.append("the same values")
        if read.facts.place != capture.scene.facts.place:
            missed.append("its place")
    if work.others.reads(kind.name):
        row |= _by_them(capture, originals, splat_file(path), work)
        if "ours_db" in row and row["by_them_db"] < min(row["ours_db"] - 0.1, 100.0):
            missed.append("splat-transform reads it as we do")
    theirs = work.theirs(kind.name, capture.scene)
    if theirs is not None:
        row |= _their_file(capture, originals, kind, theirs, work)
        row["of_theirs"] = row["bytes"] / bytes_of(theirs)
        if row["of_theirs"] > MAX_GROWTH:
            missed.append("bytes")
        if row.get("ours_db", math.inf) < row.get("theirs_db", 0.0) - MAX_LOSS_DB:
            missed.append("splat-transform's dB")
        if row.get("theirs_by_us_db", math.inf) < row.get("theirs_db", 0.0) - 0.1:
            missed.append("its file read as it does")
    return row | {"bars": f"missed: {', '.join(missed)}" if missed else "met"}


def _by_them(capture: CaptureRun, originals: Sequence[Picture], path: Path, work: TripFolder) -> Row:
    read = work.others.read(path)
    frame, placed = likely_frame(capture, read, originals)
    return {"by_them_db": decibels(capture.pictures(placed), originals), "by_them_axes": frame}


def _their_file(
    capture: CaptureRun, originals: Sequence[Picture], kind: SplatFormat, path: Path, work: TripFolder
) -> Row:
    """Measure the similarity of splat-transform's own file, read by it and by us."""
    row: Row = {}
    if work.others.reads(kind.name):
        row["theirs_db"] = decibels(capture.pictures(work.others.read(path)), originals)
    if kind.reads:
        _, placed = likely_frame(capture, kind.read(path), originals)
        row["theirs_by_us_db"] = decibels(capture.pictures(placed), originals)
    return row


def positions(scene: Scene, over: str, kind: SplatFormat, folder: Path) -> Row:
    """Return a format's row of position errors."""
    path = written(scene, kind, folder / f"positions_{over}".replace(" ", "_"))
    row = position_row(scene, kind.read(path), splat_file(path), LIKE.get(kind.name, kind.name))
    return {"format": kind.name, "over": over, "bars": "met" if row["within"] else "missed"} | row


def written(scene: Scene, kind: SplatFormat, folder: Path) -> Path:
    """Write a splat, replacing an existing file; return its path."""
    path = folder / kind.file
    if path.is_dir():
        shutil.rmtree(path)
    write_scene(path, scene, kind)
    return path


def same(a: Scene, b: Scene) -> bool:
    """Whether two splats have the same values, regardless of their quaternions' lengths."""
    one, other = a.gaussians, b.gaussians
    if len(one) != len(other) or one.sh_degree != other.sh_degree:
        return False
    turns = [torch.nn.functional.normalize(each.quats.double(), dim=1) for each in (one, other)]
    names = ("means", "log_scales", "opacity_logits", "sh")
    equal = all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)
    return equal and bool(torch.allclose(turns[0], turns[1], atol=1e-6))


def splat_file(path: Path) -> Path:
    """Return the file with the Gaussians: the path itself, or the PLY of a model folder."""
    found = sorted(path.glob("point_cloud/iteration_*/point_cloud.ply")) if path.is_dir() else []
    return found[-1] if found else path


def bytes_of(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    return (
        sum(each.stat().st_size for each in path.rglob("*") if each.is_file()) if path.is_dir() else path.stat().st_size
    )


def positions_of_site(scene: Scene, kind: SplatFormat, folder: Path) -> Row:
    """Return the row of a site of 3 km; the format may refuse to destroy it."""
    try:
        return positions(site_of(scene), SITE, kind, folder)
    except SplatpipeError as error:
        if DESTROYED not in error.message:
            raise
        return {"format": kind.name, "over": SITE, "bars": "refused: its steps would destroy the splat"}


@contextmanager
def working_folder(kept: Path | None) -> Iterator[Path]:
    """Yield the given folder, or a temporary one."""
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        yield kept
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)


def measure(out: Path, kinds: Sequence[SplatFormat], work: TripFolder, views: int) -> tuple[list[Row], list[Row]]:
    """Return a run's tables: similarity and bytes, positions."""
    capture = open_capture(out, views)
    originals = capture.pictures(capture.scene)
    rows, errors = [], []
    for kind in kinds:
        try:
            rows.append(round_trip(capture, originals, kind, work))
            if kind.reads:
                errors.append(positions(capture.scene, capture.name, kind, work.folder))
                errors.append(positions_of_site(capture.scene, kind, work.folder))
        except SplatpipeError as error:
            rows.append({"format": kind.name, "bars": f"missed: {error.message[:200]}"})
        print(f"{capture.name}: {kind.name}: {rows[-1]['bars']}", file=sys.stderr)  # a run takes minutes
    return rows, errors


def main() -> None:
    """Print both tables of each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("outs", nargs="+", type=Path, metavar="OUT", help="finished runs")
    parser.add_argument("--readers", type=Path, default=READERS, help="where npm ci was run")
    parser.add_argument("--formats", default="", help="names, with commas; all without")
    parser.add_argument("--slow", default="", help="formats that splat-transform is not to write, with commas")
    parser.add_argument("--sog-s", type=float, default=SOG_S, help="CPU seconds for the palette of its SOG")
    parser.add_argument("--views", type=int, default=5, help="held-out cameras, at most")
    parser.add_argument("--work", type=Path, help="a folder that keeps the files")
    parser.add_argument("--json", type=Path, help="leaves all figures here, too")
    options = parser.parse_args()
    wanted = set(options.formats.split(",")) - {""}
    kinds = [kind for kind in SPLAT_FORMATS if not wanted or kind.name in wanted]
    tables: dict[str, dict[str, list[Row]]] = {}
    with working_folder(options.work) as folder:
        work = TripFolder(folder, find_others(options.readers), frozenset(options.slow.split(",")), options.sog_s)
        for out in options.outs:
            rows, errors = measure(out, kinds, work, options.views)
            print_table(f"round trips of {out.name}", rows, COLUMNS)
            print_table(f"positions of {out.name}", errors, POSITION_COLUMNS)
            tables[out.name] = {"formats": rows, "positions": errors}
    if options.json is not None:
        options.json.write_text(json.dumps(tables, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
