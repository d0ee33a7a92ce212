"""Read our files with third-party programs: ``format_readers OUT``, one line per check.

Splat files are written again from the run's splat; COLMAP's folder and LAZ are those of ``splatpipe export OUT
--format colmap,laz``. Readers: splat-transform, gltf-validator, three and spark in headless Chromium, pycolmap, laspy,
pyproj (CesiumJS: `cesium_tiles`). Set up once: npm ci --prefix benchmarks/formats/readers.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from browser_pictures import SPARK_TYPES, draw, drawing_page
from captures import CaptureRun, decibels, likely_frame, open_capture
from glb_accessors import PREFIX, largest_differences, read_glb
from others import READERS, THEIR_AXES, OtherPrograms, find_others
from round_trips import splat_file, working_folder, written
from survey_readers import check_colmap, check_laz
from tables import Row, print_table

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, SplatFormat, format_named

MAX_LOSS_DB = 0.1  # below the result of our own reader
SURE_DB = 100.0  # above this, differences are rounding
LIKE_OURS_DB = 30.0  # spark renders differently
WORSE_DB = 0.5  # than the format's loss and spark's difference on the PLY together
ACCESSORS = 1e-5
MAX_PIXELS = 200_000  # largest image that the browser renders
EXPECTED = "MESH_PRIMITIVE_INVALID_ATTRIBUTE"  # gltf-validator does not know the extension's names

COLUMNS = {"reader": "reader:", "of": "format:", "what": "what:", "figure": "figure:", "bars": "bars:"}


@dataclass(frozen=True)
class Bench:
    """Common inputs of the checks.

    Attributes:
        capture: The run.
        out: Its OUT.
        folder: Folder for files.
        others: Third-party programs.
    """

    capture: CaptureRun
    out: Path
    folder: Path
    others: OtherPrograms

    def file(self, kind: SplatFormat) -> Path:
        """Return the run's splat in a format, written once."""
        path = self.folder / self.capture.name / kind.file
        return path if path.exists() else written(self.capture.scene, kind, self.folder / self.capture.name)


def line(reader: str, name: str, what: str, figure: str, met: bool) -> Row:
    """Return a row of the table."""
    return {"reader": reader, "format": name, "what": what, "figure": figure, "bars": "met" if met else "missed"}


def check_splat_transform(bench: Bench) -> Iterator[Row]:
    """Check each format that splat-transform reads: the count, and whether it looks as by our own reader."""
    capture = bench.capture
    originals = capture.pictures(capture.scene)
    for kind in SPLAT_FORMATS:
        if not bench.others.reads(kind.name) or kind.name == "streamed-sog":
            continue
        path = bench.file(kind)
        read = bench.others.read(splat_file(path))
        frame, placed = likely_frame(capture, read, originals)
        found = decibels(capture.pictures(placed), originals)
        ours = decibels(capture.pictures(kind.read(path)), originals) if kind.reads else found
        count, whole = len(read.gaussians), len(capture.scene.gaussians)
        met = count == whole and found >= min(ours - MAX_LOSS_DB, SURE_DB)
        figure = f"{count:,} of {whole:,}; {frame}; {found:.2f} dB, by our reader {ours:.2f}"
        yield line("splat-transform", kind.name, "reads it as we do", figure, met)


def check_streamed_sog(bench: Bench) -> Iterator[Row]:
    """Check streamed SOG of `splatpipe export`: each file of the first level is a SOG; together they are the splat."""
    path = bench.out / "export/streamed-sog/lod-meta.json"
    if not path.is_file():
        yield line("splat-transform", "streamed-sog", "is there", "splatpipe export OUT --format streamed-sog", False)
        return
    names = json.loads(path.read_text(encoding="utf-8"))["filenames"]
    finest = [name for name in names if name.startswith("0_")]
    count = sum(len(bench.others.read(path.parent / name).gaussians) for name in finest)
    whole = len(bench.capture.scene.gaussians)
    figure = f"{count:,} of {whole:,} in {len(finest)} of {len(names)} files"
    yield line("splat-transform", "streamed-sog", "its finest level is the splat", figure, count == whole)


def check_validator(bench: Bench) -> Iterator[Row]:
    """Run gltf-validator: the only errors allowed are unknown attributes of the extension."""
    path = bench.file(format_named("glb"))
    ended = bench.others.run(READERS / "validate.mjs", path.resolve())
    messages = json.loads(ended.said)["messages"]
    bad = [message for message in messages if message["severity"] < 2 and not _is_expected(message)]
    said = "; ".join(f"{message['code']} {message['pointer']}" for message in bad[:3]) or "no error, no warning"
    expected = sum(_is_expected(message) for message in messages)
    figure = f"{said}; {expected} names that it does not know"
    yield line("gltf-validator", "glb", "valid", figure, not bad and expected > 0)


def _is_expected(message: dict[str, str]) -> bool:
    name = message["pointer"].rpartition("/")[2]
    return message["code"] == EXPECTED and name.startswith(PREFIX)


def check_accessors(bench: Bench) -> Iterator[Row]:
    """Compare our GLB's accessors with those of splat-transform's."""
    source = bench.folder / "theirs_from.ply"
    write_splat(source, bench.capture.scene.turned(THEIR_AXES).gaussians)
    theirs, _ = bench.others.write("glb", source, bench.folder)
    ours, other = read_glb(bench.file(format_named("glb"))), read_glb(theirs)
    names = set(ours.attributes) ^ set(other.attributes)
    found = largest_differences(ours, other) if not names else {}
    worst = max(found, key=lambda name: found[name], default="")
    figure = f"{len(found)} accessors, largest {found.get(worst, math.nan):.1e} ({worst.removeprefix(PREFIX)})"
    figure = f"only one has {', '.join(sorted(names))}" if names else figure
    yield line("splat-transform", "glb", "accessors as its own", figure, bool(found) and found[worst] <= ACCESSORS)
    kept = ("kernel", "colorSpace", "projection", "sortingMethod")
    facts = [glb.primitive["extensions"]["KHR_gaussian_splatting"] for glb in (ours, other)]
    same = {name: facts[0].get(name) == facts[1].get(name) for name in kept if name in facts[0] or name in facts[1]}
    figure = ", ".join(f"{name}={facts[0].get(name)}" for name in same)
    yield line("splat-transform", "glb", "the extension's facts as its own", figure, all(same.values()))


def check_spark(bench: Bench) -> Iterator[Row]:
    """Compare spark's images (GLB by three's loader) with our rasterizer's."""
    scene, camera = bench.capture.scene, bench.capture.cameras[0]
    shrink = math.sqrt(min(1.0, MAX_PIXELS / (camera.width * camera.height)))
    camera = camera.scaled(round(camera.width * shrink), round(camera.height * shrink))
    capture = replace(bench.capture, cameras=[camera])
    flat = replace(scene, gaussians=replace(scene.gaussians, sh=scene.gaussians.sh[:, :1]))
    wanted = {"full": capture.pictures(scene), "flat": capture.pictures(flat)}
    baseline = math.nan
    with drawing_page(bench.others, bench.folder) as page:
        for name in SPARK_TYPES:
            kind = next((each for each in SPLAT_FORMATS if each.name == name), None)
            if kind is None:
                continue
            path = bench.file(kind)
            read = kind.read(path)
            address = path.relative_to(bench.folder).as_posix()
            count, picture = draw(page, address, name, read.facts.axes, camera, scene.facts.antialias)
            found = decibels([picture], wanted["flat" if name == "glb" else "full"])
            baseline = found if name == "ply" else baseline
            loss = decibels(capture.pictures(read), wanted["full"])
            asked = max(
                LIKE_OURS_DB, -10.0 * math.log10(10.0 ** (-baseline / 10.0) + 10.0 ** (-loss / 10.0)) - WORSE_DB
            )
            met = count == len(scene.gaussians) and found >= asked
            what = "colours without harmonics" if name == "glb" else "as our rasterizer draws it"
            reader = "three, spark" if name == "glb" else "spark"
            yield line(reader, name, what, f"{count:,} splats; {found:.2f} dB, asked {asked:.2f}", met)


def check_exports(bench: Bench) -> Iterator[Row]:
    """Read with pycolmap and laspy what `splatpipe export` wrote."""
    for reader, name, what, figure, met in (*check_colmap(bench.out), *check_laz(bench.out, bench.capture.scene)):
        yield line(reader, name, what, figure, met)


CHECKS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "splat-transform": check_splat_transform,
    "streamed": check_streamed_sog,
    "validator": check_validator,
    "accessors": check_accessors,
    "spark": check_spark,
    "exports": check_exports,
}


def run_checks(bench: Bench, names: Sequence[str]) -> list[Row]:
    """Return all rows; a check that cannot be run is a row, too."""
    rows = []
    for name in names:
        try:
            rows += list(CHECKS[name](bench))
        except (SplatpipeError, OSError, KeyError, ValueError) as error:
            rows.append(line(name, "", "can be checked", f"{type(error).__name__}: {str(error)[:200]}", False))
        print(f"{name}: done", file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="a finished run")
    parser.add_argument("--readers", type=Path, default=READERS, help="where npm ci was run")
    parser.add_argument("--checks", default=",".join(CHECKS), help="which, with commas")
    parser.add_argument("--views", type=int, default=2, help="held-out cameras, at most")
    parser.add_argument("--work", type=Path, help="a folder that keeps the files")
    parser.add_argument("--json", type=Path, help="leaves all figures here, too")
    options = parser.parse_args()
    with working_folder(options.work) as folder:
        capture = open_capture(options.out, options.views)
        bench = Bench(capture, options.out, folder, find_others(options.readers))
        rows = run_checks(bench, options.checks.split(","))
    print_table(f"{options.out.name} read by others", rows, COLUMNS)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    sys.exit(0 if all(row["bars"] == "met" for row in rows) else 1)


if __name__ == "__main__":
    main()
