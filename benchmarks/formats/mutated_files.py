"""Feed damaged files to every reader: ``mutated_files [--count 5000] [--formats spz,sog] [--samples FOLDER]``.

Each file is derived from a valid one with a seed, and read in a process with limited memory. Required: no crash, none
over 5 s or 500 MB, and no error but ours. Failures are reported with their seed; ``--save FOLDER`` keeps the files.
``--samples`` names a folder with further valid files from third-party writers: files or folders named
``FORMAT-anything``.
"""

from __future__ import annotations

import argparse
import json
import select
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mutations import mutated
from tables import Row, print_table

from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, SplatFormat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts, SplatOrigin

SLOW_S = 5.0  # CPU time above which reading a file counts as slow
WORKER = Path(__file__).with_name("read_worker.py")
HANG_S = 60.0  # wall-clock time, on a shared machine
MAX_BYTES = 500_000_000
MAX_SAMPLE_BYTES = 8 << 20  # a larger file is not used as a sample: reading thousands of it takes hours
BY_CONTENT = 4  # every n-th file must first be recognised by its content
ENDS = ("read", "refused", "crashed", "unsound", "slow", "memory")
COLUMNS = {
    "format": "format:",
    "files": "files:,",
    **{end: f"{end}:," for end in ENDS},
    "longest s": "longest_s:.2f",
    "most MB": "most_bytes:MB",
    "bars": "bars:",
}


@dataclass(frozen=True)
class Sample:
    """A valid splat file, with its accompanying files.

    Attributes:
        splat_format: Format in the registry.
        main: Path given to the reader, relative to the folder; empty for the folder itself.
        files: All files, by path relative to the folder.
    """

    splat_format: SplatFormat
    main: str
    files: dict[str, bytes]

    def write(self, folder: Path) -> Path:
        """Write it into an empty folder; return the path to read."""
        for name, data in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return folder / self.main


@dataclass(frozen=True)
class Failure:
    """A file that a reader did not handle safely.

    Attributes:
        splat_format: Name of the format.
        seed: Seed that reproduces the file.
        what: The damage.
        end: One of ``ENDS``.
        detail: How the reader failed.
    """

    splat_format: str
    seed: int
    what: str
    end: str
    detail: str


def small_scene(count: int, degree: int) -> Scene:
    """Return random Gaussians with metadata of every kind."""
    generator = torch.Generator().manual_seed(count)
    gaussians = Gaussians.empty(count, degree)
    gaussians.means = 10.0 * torch.randn(count, 3, generator=generator)
    gaussians.log_scales = torch.randn(count, 3, generator=generator) - 2.0
    gaussians.quats = torch.randn(count, 4, generator=generator)
    gaussians.opacity_logits = 2.0 * torch.randn(count, generator=generator)
    gaussians.sh = 0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=generator)
    place = SplatOrigin(52.21, 20.97, 110.0, "ellipsoidal", "EPSG:32634")
    return Scene(gaussians, SceneFacts(metres=True, place=place, edits=({"step": "crop", "kept": count},)))


def own_samples(splat_format: SplatFormat) -> list[Sample]:
    """Return our writer's output for small scenes."""
    found = []
    for count, degree in ((300, 3), (40, 1), (1, 0)):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / splat_format.file
            path.parent.mkdir(parents=True, exist_ok=True)
            splat_format.write(path, small_scene(count, degree))
            found.append(_sample(splat_format, Path(folder), splat_format.file))
    return found


def foreign_samples(splat_format: SplatFormat, folder: Path) -> list[Sample]:
    """Return the samples in a folder that are named after a format."""
    found = []
    for path in sorted(folder.glob(f"{splat_format.name}-*")):
        if path.is_dir():
            name = Path(splat_format.file).name
            found.append(_sample(splat_format, path, name if (path / name).exists() else ""))
        elif path.stat().st_size <= MAX_SAMPLE_BYTES:
            found.append(Sample(splat_format, path.name, {path.name: path.read_bytes()}))
    return found


def _sample(splat_format: SplatFormat, folder: Path, main: str) -> Sample:
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return Sample(splat_format, main, {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths})


def damaged(samples: Sequence[Sample], seed: int) -> tuple[str, Sample]:
    """Return the damage done to one of a format's samples, and the result; the same for the same seed."""
    generator = np.random.default_rng([seed, zlib.crc32(samples[0].splat_format.name.encode())])
    sample = samples[generator.integers(len(samples))]
    others = samples[generator.integers(len(samples))].files
    names = sorted(sample.files)
    name = names[generator.integers(len(names))]
    if len(names) > 1 and generator.random() < 0.03:
        return "file missing", Sample(
            sample.splat_format, sample.main, {key: data for key, data in sample.files.items() if key != name}
        )
    other = others[sorted(others)[generator.integers(len(others))]]
    what, data = mutated(sample.files[name], other, generator)
    return what, Sample(sample.splat_format, sample.main, sample.files | {name: data})


class ReadProcess:
    """A reading process, restarted whenever one ends.

    Args:
        worker: Script of the process.
        patience_s: Wall-clock seconds to wait for an answer.
    """

    def __init__(self, worker: Path = WORKER, patience_s: float = HANG_S) -> None:
        self._worker, self._patience_s = worker, patience_s
        self._process: subprocess.Popen[str] | None = None

    def read(self, splat_format: str, path: Path) -> dict[str, Any]:
        """Return how reading a file ended; see ``read_worker``."""
        process = self._process or self._started()
        self._process = process
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps({"format": splat_format, "path": str(path)}) + "\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], self._patience_s)
        line = process.stdout.readline() if ready else ""
        if line:
            found: dict[str, Any] = json.loads(line)
            return found
        ended = process.wait() if ready else None
        self.close()
        if not ready:
            detail = f"no answer in {self._patience_s:.0f} s"
            return {"outcome": "slow", "detail": detail, "cpu_s": self._patience_s, "peak_bytes": 0}
        detail = f"the process ended with {ended}"
        return {"outcome": "crashed", "detail": detail, "cpu_s": 0.0, "peak_bytes": 0}

    def close(self) -> None:
        """Terminate the process."""
        if self._process is not None:
            assert self._process.stdin is not None and self._process.stdout is not None
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _started(self) -> subprocess.Popen[str]:
        command = [sys.executable, str(self._worker)]
        pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=nowhere, text=True)
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            process.kill()
            raise RuntimeError("a reader fails before it reads: run read_worker by hand")
        return process


def end_of(answer: dict[str, Any]) -> str:
    """Classify an answer as one of ``ENDS``."""
    if answer["outcome"] == "read" and answer["detail"]:
        return "unsound"
    if answer["outcome"] in ("read", "refused"):
        if answer["peak_bytes"] > MAX_BYTES:
            return "memory"
        if answer["cpu_s"] > SLOW_S:
            return "slow"
    return str(answer["outcome"])


def attack(samples: Sequence[Sample], seeds: Sequence[int], process: ReadProcess, save: Path | None) -> Attack:
    """Read a format's damaged files.

    Args:
        samples: Valid files of one format, at least one.
        seeds: One file is made from each.
        process: The reading process.
        save: Folder for the files that fail; None to keep nothing.
    """
    name = samples[0].splat_format.name
    found = Attack(name, Counter(), [], 0.0, 0)
    for seed in seeds:
        what, sample = damaged(samples, seed)
        with tempfile.TemporaryDirectory() as folder:
            by_content = seed % BY_CONTENT == 0
            answer = process.read("" if by_content else name, sample.write(Path(folder)))
            end = end_of(answer)
            if end not in ("read", "refused"):
                found.failures.append(Failure(name, seed, what, end, answer["detail"]))
                if save is not None:
                    shutil.copytree(folder, save / f"{name}-{seed}", dirs_exist_ok=True)
        found.ends[end] += 1
        found.longest_s = max(found.longest_s, answer["cpu_s"])
        found.most_bytes = max(found.most_bytes, answer["peak_bytes"])
    return found


@dataclass
class Attack:
    """Result of attacking a format's reader.

    Attributes:
        splat_format: Name of the format.
        ends: Number of files by how reading them ended.
        failures: Files that the reader did not handle safely.
        longest_s: CPU seconds of the slowest file.
        most_bytes: Largest rise in memory.
    """

    splat_format: str
    ends: Counter[str]
    failures: list[Failure]
    longest_s: float
    most_bytes: int

    def row(self) -> Row:
        """Return a row for the table."""
        figures: Row = {"format": self.splat_format, "files": self.ends.total(), "longest_s": self.longest_s}
        figures |= {end: self.ends[end] for end in ENDS} | {"most_bytes": self.most_bytes}
        return figures | {"bars": "missed" if self.failures else "met"}


def readable() -> Iterator[SplatFormat]:
    """Yield the formats that have a reader."""
    return (splat_format for splat_format in SPLAT_FORMATS if splat_format.reads)


def main() -> None:
    """Print a table by format, and each failure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5000, help="files of each format")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--formats", default="", help="names, with commas; all without")
    parser.add_argument("--samples", type=Path, help="whole files by others' writers")
    parser.add_argument("--save", type=Path, help="a folder that keeps what fails")
    parser.add_argument("--json", type=Path, help="leaves all figures here, too")
    options = parser.parse_args()
    wanted = set(options.formats.split(",")) - {""}
    process, attacks = ReadProcess(), []
    for splat_format in readable():
        if wanted and splat_format.name not in wanted:
            continue
        samples = own_samples(splat_format)
        if options.samples is not None:
            samples += foreign_samples(splat_format, options.samples)
        seeds = range(options.first, options.first + options.count)
        attacks.append(attack(samples, seeds, process, options.save))
    process.close()
    rows = [found.row() for found in attacks]
    print_table(f"mutated files: {options.count:,} a format", rows, COLUMNS)
    failures = [failure for found in attacks for failure in found.failures]
    for failure in failures:
        print(f"{failure.splat_format} seed {failure.seed}: {failure.end} ({failure.what}): {failure.detail}")
    if options.json is not None:
        text = json.dumps({"rows": rows, "failures": [vars(failure) for failure in failures]}, indent=1)
        options.json.write_text(text + "\n", encoding="utf-8")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
