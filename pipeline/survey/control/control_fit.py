"""From observations to a frame by control and positions together, without a bundle adjustment.

``georef`` starts from it, and the marking page shows it while points are being marked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.joint_fit import JointFit, JointObservations, Priors, fit_jointly
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.control.blunders import name_blunders, require_shape
from splatpipe.pipeline.survey.control.local_survey import (
    LocalSurvey,
    Stations,
    make_site,
    observed_in,
    require_fit,
    start_similarity,
)
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.survey.placing.fitting import MIN_POSITIONS
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.points.surveyed_points import Survey


@dataclass(frozen=True)
class ControlFit:
    """A model fitted to control and positions.

    Attributes:
        site: The survey in the world frame.
        survey: The points, blunders left out.
        start: The similarity that the fit started from, and priors.
        observed: Control and positions.
        fit: The frame.
    """

    site: LocalSurvey
    survey: Survey
    start: tuple[Similarity, Priors]
    observed: JointObservations
    fit: JointFit


def fit_control(
    survey: Survey,
    geodetic: Float64[np.ndarray, "n 3"],
    stations: Stations,
    placed: tuple[SparseModel, Positions, Frame | None],
    config: GeorefConfig,
    report: Reporter,
    moved: Callable[[Similarity, LocalSurvey], Similarity] | None = None,
) -> ControlFit:
    """Fit a frame.

    Args:
        survey: The points.
        geodetic: Their latitudes, longitudes and heights.
        stations: The photos' positions that are used.
        placed: The model, all positions, and the frame by these alone; None if they give none.
        config: Options.
        report: Receives warnings.
        moved: Changes the start by what the points are worth before any is marked.

    Raises:
        FrameUndeterminedError: if there are neither positions nor enough control.
        SplatpipeError: if the control's geometry contradicts the model's.
    """
    model, positions, frame = placed
    site = make_site(survey, geodetic, stations, frame, config)
    similarity, priors = start_similarity(site, survey, model, positions, frame)
    start = (similarity if moved is None else moved(similarity, site)), priors
    if frame is not None and len(stations) >= MIN_POSITIONS:  # only then is the start level, and in metres
        require_shape(survey, site, start[0])
    survey = name_blunders(survey, site, model, start, config, report)
    observed = observed_in(site, survey, model, start[0].scale, config.mark_sigma_px)
    fit = fit_jointly(start[0], observed, start[1])
    require_fit(fit, observed, survey)
    return ControlFit(site, survey, start, observed, fit)
