"""Georef: the frame that a model lies in, from the photos' positions or, without them, from how cameras are held."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.scene.frames import save_frame
from splatpipe.pipeline.scene.photos import load_photo_list
from splatpipe.pipeline.scene.world import in_crs
from splatpipe.stages.georef.gps import NoPlaceError, georeference, read_positions, tell
from splatpipe.stages.georef.level import arbitrary_frame
from splatpipe.stages.georef.model import copy_model, read_model
from splatpipe.stages.line import GeorefConfig


def run(config: GeorefConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the parts frame (``frame.json``) and model (the sparse model, byte for byte).

    Raises:
        SplatpipeError: if the model cannot be read or has no photos.
    """
    source = inputs["sparse.model"]
    report.progress(0, 2, "reading the model", "steps")
    model = read_model(source, load_photo_list(inputs["ingest.photos"]).by_name())
    positions = read_positions(inputs["ingest.positions"])
    report.progress(1, 2, "fitting the positions", "steps")
    used = 0
    try:
        frame, fit = georeference(model, positions, config.max_position_error_m, config.vertical)
        frame = in_crs(frame, config.crs, approximate=config.approximate_crs)
        used = int(fit.inliers.sum())
        tell(frame, fit, model, positions, report)
    except NoPlaceError as error:
        frame = arbitrary_frame(model, positions, str(error))
        report.warning(f"Arbitrary scale: {error}.", "Lengths and heights in this result have no unit.")
    save_frame(frame, out / "frame.json")
    copy_model(source, out / "sparse" / "0", may_link=inputs.photos_dir not in source.parents)
    report.progress(2, 2, "fitting the positions", "steps")
    residuals = {key: value for key, value in frame.residuals.items() if key.startswith("rmse")}
    return {
        "kind": frame.kind,
        "note": frame.note,
        "positions_used": used,
        "positions_left_out": len(frame.left_out),
        **residuals,
    }
