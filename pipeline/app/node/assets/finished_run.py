"""A finished run as it is packed: the files in OUT that it made, where it lies, and why something is missing."""

from __future__ import annotations

import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from splatpipe.pipeline.app.node.assets.earth import Earth, open_earth
from splatpipe.pipeline.app.node.assets.layout import Place
from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs, read_report_inputs
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.output_file import is_inside
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.stages.line import LINE

REPORTS = ("report.html", "report.pdf")
NOT_ASKED_FOR = "it was not asked for"


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """What a run has left in OUT.

    Attributes:
        inputs: What its report is made from, too.
        files: Its deliverables and reports by path relative to OUT, without those of earlier runs, sorted.
        earth: Where it lies; None if it has no scale, or is not georeferenced yet.
    """

    inputs: ReportInputs
    files: Mapping[str, Path]
    earth: Earth | None

    def why_absent(self, place: Place) -> str:
        """Why a product is not there, as part of a sentence."""
        history = self.inputs.history.stages.get(place.stage)
        if not place.stage:
            return "it could not be written"
        if not self._asked_for(place):
            return NOT_ASKED_FOR
        path = self.inputs.out / place.source.rstrip("/")
        if path.is_symlink() or path.exists():
            return f"the one in OUT is {'a link' if path.is_symlink() else 'of an earlier run'}"
        if history is not None and history.state == "failed":
            return f"its stage {place.stage} failed: {history.message.rstrip('.') or 'see the log'}"
        if place.stage not in self.inputs.artifacts:
            return f"the run ended before its stage {place.stage}"
        warnings = [] if history is None else [text for text, _ in history.messages.warnings]
        said = [text for text in warnings if not place.format or text.startswith(f"{place.format} ")]
        return said[-1].rstrip(".") if said else f"its stage {place.stage} made none"

    def _asked_for(self, place: Place) -> bool:
        options = getattr(self.inputs.config, place.stage, None)
        if place.format:
            return place.format in str(getattr(options, "formats", place.format)).split(",")
        return bool(getattr(options, "enabled", True))


def open_finished_run(out: Path) -> FinishedRun:
    """Open a run that has ended, whether well or not.

    Raises:
        UsageError: if there is no run, or one that is running.
    """
    if open_run_folder(out, LINE).is_running:
        raise UsageError(f"{out} is being worked in.", hint="Wait until the run has ended.")
    inputs = read_report_inputs(out)
    names = [*(each.name for each in inputs.deliverables if each.current), *REPORTS]
    files = {name: inputs.out / name for name in sorted(names) if _is_own_file(inputs.out, name)}
    return FinishedRun(inputs, files, _earth(inputs))


def _is_own_file(out: Path, name: str) -> bool:
    """Whether a file is OUT's own, and neither a link nor below one."""
    try:
        return is_inside(out, PurePosixPath(name)) and stat.S_ISREG((out / name).lstat().st_mode)
    except OSError:
        return False


def _earth(inputs: ReportInputs) -> Earth | None:
    part = inputs.part("georef.frame")
    try:
        return None if part is None else open_earth(load_frame(part))
    except SplatpipeError:  # the run says so itself, and has no products in a CRS
        return None
