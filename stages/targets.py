"""targets: detect coded targets and quadrant targets in the photos, if control points or scale bars need them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.files.photo_list import Photo, decode, load_photo_list
from splatpipe.pipeline.photos.targets.coded_targets import find_coded_targets
from splatpipe.pipeline.photos.targets.quadrant_targets import find_quadrant_targets
from splatpipe.pipeline.sfm.matching.keypoints import single_threaded_opencv
from splatpipe.pipeline.survey.options import TargetsConfig
from splatpipe.pipeline.survey.placing.gps import read_positions
from splatpipe.pipeline.survey.placing.model import read_model
from splatpipe.pipeline.survey.targets.expected_places import Window, expected_windows
from splatpipe.pipeline.survey.targets.target_finds import QUADRANT, TargetFind, load_wanted, save_finds

COVERED_RADIUS_SHARE = 0.8  # radius around a coded target, over its size, in which quadrants are ignored


def run(config: TargetsConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the part found (``targets.json``): every target in the photos that have a pose; none if none is needed.

    Raises:
        SplatpipeError: if a photo has changed.
    """
    wanted = load_wanted(inputs["control.points"])
    if not wanted or not config.search:
        save_finds((), out / "targets.json")
        report.progress(1, 1, "there are no targets to detect", "steps")
        return {"photos": 0, "coded": 0, "quadrants": 0}
    photos = load_photo_list(inputs["ingest.photos"]).by_name()
    model = read_model(inputs["sparse.model"], photos)
    positions = read_positions(inputs["ingest.positions"])
    windows = expected_windows(wanted, model, positions, photos, inputs.settings)
    work = partial(_found_in, part=inputs["ingest.photos"], photos_dir=inputs.photos_dir)
    found: list[TargetFind] = []
    with single_threaded_opencv():
        items = [(photos[name], windows[name]) for name in sorted(windows)]
        for number, finds in enumerate(ordered_map(work, items, inputs.machine.threads), 1):
            found += finds
            report.progress(number, len(items), "detecting targets", "photos")
    save_finds(found, out / "targets.json")
    coded = sum(find.number is not None for find in found)
    return {"photos": len(items), "coded": coded, "quadrants": len(found) - coded}


def _found_in(item: tuple[Photo, Window], part: Path, photos_dir: Path) -> list[TargetFind]:
    """Return the targets in a window of a photo, in pixels of the whole photo."""
    photo, (left, top, right, bottom) = item
    pixels = decode(photo, part, photos_dir)[top:bottom, left:right]
    finds = [
        TargetFind(photo.name, t.dictionary, t.number, t.x + left, t.y + top, t.size_px, t.sigma_px)
        for t in find_coded_targets(pixels)
    ]
    # The corners between cells of a large coded target look like quadrant targets.
    finds += [
        TargetFind(photo.name, QUADRANT, None, t.x + left, t.y + top, t.size_px, t.sigma_px)
        for t in find_quadrant_targets(pixels)
        if all(max(abs(t.x + left - f.x), abs(t.y + top - f.y)) > COVERED_RADIUS_SHARE * f.size_px for f in finds)
    ]
    return finds
