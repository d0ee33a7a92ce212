"""Reduces a splat to a number of Gaussians or to a size of the output file in bytes."""

from __future__ import annotations

import math
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from splatpipe.pipeline.edit.workpiece import Workpiece
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.splat.formats.catalogue import SplatFormat
from splatpipe.pipeline.splat.formats.files import write_scene
from splatpipe.pipeline.splat.levels.reduction import Reduction, reduce_further, reduce_to
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene

MAX_GAUSSIANS = 10**10  # Gaussians: more than any machine holds
UNITS = {"KB": 10**3, "MB": 10**6, "GB": 10**9}
SAMPLE = 50_000  # Gaussians written to estimate the bytes per Gaussian
MAX_ROUNDS = 5  # at most, of writing and measuring: the bytes per Gaussian depend on their number
FULL_SHARE = 0.93  # share of the allowed bytes that is close enough
NEXT_COUNT_SHARE = 0.985  # share of the Gaussians that would just fit which the next round writes
FORM = "500000, 100MB or 1.5GB"

_COUNT = re.compile(r"[0-9]{1,11}", re.ASCII)
_BYTES = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,6})?) ?([KMG]B)", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class OutputFile:
    """The file to write.

    Attributes:
        path: The output path.
        kind: Its format.
    """

    path: Path
    kind: SplatFormat


@dataclass(frozen=True)
class Reduce:
    """Merge neighbouring Gaussians until the splat is small enough; one that already is stays unchanged.

    Attributes:
        output: The file whose size counts.
        count: Target number of Gaussians; 0 if a size is given.
        size_bytes: Target size of the output; 0 if a count is given.
    """

    output: OutputFile
    count: int = 0
    size_bytes: int = 0

    @staticmethod
    def parse(text: str, option: str, output: OutputFile) -> Reduce:
        """Parse a number of Gaussians, or a size with its unit.

        Raises:
            UsageError: if it is anything else, or zero.
        """
        text = text.strip()
        if _COUNT.fullmatch(text) and 0 < int(text) <= MAX_GAUSSIANS:
            return Reduce(output, count=int(text))
        match = _BYTES.fullmatch(text)
        size = int(float(match[1]) * UNITS[match[2].upper()]) if match else 0
        if size <= 0:
            raise UsageError(f'Cannot understand {option} "{text[:60]}".', hint=f"Write it as {option} {FORM}.")
        return Reduce(output, size_bytes=size)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Reduce the splat; returns the record of the step.

        Raises:
            SplatpipeError: if not even one Gaussian fits.
            MachineError: if a trial file cannot be written.
        """
        if self.count:
            if len(piece) > self.count:
                piece.replace_gaussians(
                    reduce_further(Reduction.unmerged(piece.with_motion_applied()), self.count).gaussians
                )
            return {"step": "reduce", "to": self.count}
        piece.replace_gaussians(self._fitting(piece.scene()))
        return {"step": "reduce", "bytes": self.size_bytes, "format": self.output.kind.name}

    def _fitting(self, scene: Scene) -> Gaussians:
        """The largest reduction that fits, found by writing trial files."""
        whole = scene.gaussians
        sample = whole.select(torch.arange(0, len(whole), max(1, -(-len(whole) // SAMPLE))))
        each = self._bytes(replace(scene, gaussians=sample)) / max(1, len(sample))
        count, too_many = min(len(whole), max(1, int(self.size_bytes / each))), len(whole) + 1
        best = 0  # the largest count known to fit; it is merged again at the end rather than kept in memory
        for _ in range(MAX_ROUNDS):
            tried = reduce_to(whole, count)
            size = self._bytes(replace(scene, gaussians=tried))
            if size <= self.size_bytes:
                best = count
                if count >= len(whole) or size >= FULL_SHARE * self.size_bytes:
                    return tried
            else:
                too_many = count
            del tried
            wanted = math.floor(NEXT_COUNT_SHARE * count * self.size_bytes / size)
            wanted = max(1, min(wanted, too_many - 1, len(whole)))
            if best and wanted <= best:
                break
            count = wanted
        if not best:
            raise SplatpipeError(
                f"{self.size_bytes / 1e6:g} MB is too small for a {self.output.kind.name} of this splat.",
                hint="Ask for more, or choose a format that compresses better.",
            )
        return reduce_to(whole, best)

    def _bytes(self, scene: Scene) -> int:
        """Bytes of the scene when written, measured by writing it into the output's folder, which has the space."""
        self.output.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".splatpipe-", dir=self.output.path.parent) as folder:
            path = Path(folder) / self.output.path.name
            write_scene(path, scene, self.output.kind)
            files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
            return sum(file.stat().st_size for file in files)
