"""The ``--help`` text of each command after its first sentence: inputs and outputs, examples, further reading."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import typer

from splatpipe.pipeline.app.cli.groups import with_groups

RUN_EXITS = (
    "0 done, 1 the photos or files cannot be used, 2 invalid command line, 3 a stage failed, 4 this machine lacks "
    "something; 130 and 143 stopped: repeat the command to resume."
)


@dataclass(frozen=True)
class HelpPage:
    """The rest of a command's help.

    Args:
        about: What it reads and writes.
        examples: Example calls, without the program's name.
        see_also: The documentation page.
        exits: Exit codes, if relevant.
    """

    about: str
    examples: tuple[str, ...]
    see_also: str
    exits: str = ""

    def epilog(self) -> str:
        """The text after the options."""
        calls = "\n".join(f"  splatpipe {call}" for call in self.examples)
        parts = ["Examples:" if len(self.examples) > 1 else "Example:", calls]
        if self.exits:
            parts.append(f"Exit codes: {self.exits}")
        return "\n\n".join([*parts, f"See also: {self.see_also}"])


PAGES = {
    "run": HelpPage(
        "Reads JPEG, PNG or TIFF photos (GPS from EXIF and XMP), or a film, and beside them gcp_list.txt, geo.txt, "
        "boundary.geojson and masks/, if present. Writes to OUT splat.ply, viewer.html, report.html, "
        "georef.json, ortho.tif, dsm.tif, a film and more, and the stages' artifacts in OUT/stages. The "
        "photos are not changed.",
        ("run PHOTOS OUT --preset preview", "run PHOTOS OUT --time-budget 2h --set export.sky=true"),
        "docs/products.md, docs/options.md, docs/budgets.md",
        RUN_EXITS,
    ),
    "demo": HelpPage(
        "Reads 40 rendered photos of a farmhouse with control points, which ship with the package. Writes to OUT "
        "what a run on your own photos would write; it takes minutes and 1.2 GB of memory.",
        ("demo out/demo",),
        "README.md, docs/products.md",
        RUN_EXITS,
    ),
    "batch": HelpPage(
        "Reads a folder of capture folders, or a list (TOML, CSV) with options for each. Writes a run to OUT/NAME for "
        "each capture, and batch.html, batch.csv and batch.json about all of them.",
        ("batch CAPTURES OUT --dry-run", "batch captures.toml OUT --retries 3"),
        "docs/unattended.md, docs/processes.md",
        "0 all captures succeeded, 1 some failed, 2 invalid command line or list, 3 Snakemake failed, 4 this "
        "machine lacks something; 130 and 143 stopped.",
    ),
    "stage": HelpPage(
        "Reads the artifacts of earlier stages in OUT. Writes the stage's own; stages that depend on it become out "
        "of date (see splatpipe status), and splatpipe run runs them again.",
        ("stage evaluate OUT", "stage train OUT --shard 2"),
        "docs/stages.md, docs/blocks.md",
        RUN_EXITS,
    ),
    "georef": HelpPage(
        "Reads OUT and the control points. Updates the georeference in all files of OUT; trains again only if the "
        "control bends the model.",
        ("georef OUT --gcp gcp_list.txt", "georef OUT --set georef.crs=EPSG:2178"),
        "docs/surveying.md, docs/coordinates.md",
        RUN_EXITS,
    ),
    "surface": HelpPage(
        "Reads a run with a metric scale. Writes to OUT the orthophoto and the surface model as GeoTIFFs, façade "
        "elevations, a dense cloud (LAZ), a mesh, sections and volumes, as requested.",
        ("surface OUT --products ortho,dsm --gsd 2cm", "surface OUT --volume heaps.geojson --base lowest"),
        "docs/surfaces.md",
        RUN_EXITS,
    ),
    "export": HelpPage(
        "Reads a finished run. Writes the files to OUT/export; each records its up axis and its georeference.",
        ("export OUT --format spz,tiles",),
        "docs/formats.md",
        RUN_EXITS,
    ),
    "convert": HelpPage(
        "Reads a PLY (also compressed), SPZ, SOG, GLB, or a trainer's model folder. Writes one file, in the "
        "format of its extension. Needs no run.",
        ("convert splat.ply splat.spz", "convert splat.ply splat.sog"),
        "docs/formats.md",
    ),
    "render": HelpPage(
        "Reads a finished run. Writes a film or a folder of pictures to OUT/renders, or to --output.",
        ("render OUT --path orbit --seconds 20", "render OUT --stills --what depth"),
        "docs/viewing.md",
    ),
    "view": HelpPage(
        "Reads OUT, even during a run. Serves pages until Ctrl-C, to whoever has the address that it prints; "
        "writes nothing, except with --mark the positions of control points in the photos.",
        ("view OUT", "view OUT --mark --points control.csv"),
        "docs/viewing.md",
    ),
    "start": HelpPage(
        "Opens a page on which a folder of photos is dropped, checked, started and watched; nobody else can use it. "
        "Keeps everything in FOLDER, by default splatpipe in your home folder. Ctrl-C ends it; work is kept.",
        ("start", "start ~/surveys --keep 30"),
        "docs/node.md",
    ),
    "node": HelpPage(
        "Takes photos over HTTP as NodeODM does, so that WebODM, CloudODM, ClusterODM and PyODM can use it. Keeps "
        "uploads, runs and results in FOLDER, and goes on where it was when it is started again. It listens on this "
        "machine only, unless --host and a token are given, and is not encrypted: put a proxy in front of it.",
        ("node ~/node", "node /srv/node --host 0.0.0.0 --parallel 2 --keep 30"),
        "docs/node.md",
    ),
    "status": HelpPage(
        "Reads OUT, even during a run, and changes nothing.",
        ("status OUT",),
        "docs/stages.md",
    ),
    "report": HelpPage(
        "Writes report.html and report.pdf into OUT. A run does so by itself; this is for one that was stopped.",
        ("report OUT",),
        "docs/products.md",
    ),
    "tidy": HelpPage(
        "Reads OUT. Removes artifacts of older options and photos from OUT/stages, and nothing else in OUT.",
        ("tidy OUT",),
        "docs/stages.md",
    ),
    "options": HelpPage(
        "Prints the options that --set and a --config file take.",
        ("options --preset high",),
        "docs/options.md",
    ),
    "doctor": HelpPage(
        "Examines processor, memory, disk, CUDA and libraries; writes nothing.",
        ("doctor", "doctor OUT --json"),
        "docs/cuda.md, docs/containers.md",
    ),
    "check": HelpPage(
        "Reads the photos and the surveyor's files beside them, in half a minute. Writes check.html with a map: low "
        "overlap, blurred photos, missing positions; and the time, memory and disk space of a run.",
        ("check PHOTOS", "check PHOTOS -o site.html"),
        "docs/preflight.md",
        "0 it can be reconstructed, possibly with warnings, 1 it cannot as it stands, 2 invalid command line.",
    ),
    "edit": HelpPage(
        "Reads a splat of any format, or a run. Writes a new file, a record of the steps beside it "
        "(NAME.edits.json), and pictures before and after. Coordinates are in the splat's CRS, or local if it is not "
        "georeferenced.",
        (
            "edit OUT site.sog --crop-polygon site.geojson --reduce 50MB",
            "edit splat.ply moved.ply --rotate 37 --move 0,0,1.5",
        ),
        "docs/edit.md",
    ),
}


def with_help(app: typer.Typer, **how: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator that registers a function as a command with its help page.

    Args:
        app: The application.
        how: Keyword arguments for ``app.command``.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        page = PAGES[function.__name__]
        sentence = inspect.cleandoc(function.__doc__ or "").partition("\n\n")[0]
        app.command(help=f"{sentence}\n\n{page.about}", epilog=page.epilog(), **how)(with_groups(function))
        return function

    return register
