"""All options of the line, a section a stage; each room has its own. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.engine.stage import StageConfig
from splatpipe.pipeline.film.options import FlythroughConfig
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.options import IngestConfig, UndistortConfig
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig, SparseConfig
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.web.options import ExportConfig


class LineConfig(StageConfig):
    """Everything that changes the answer, a section a stage."""

    ingest: IngestConfig = IngestConfig()
    features: FeaturesConfig = FeaturesConfig()
    matches: MatchesConfig = MatchesConfig()
    sparse: SparseConfig = SparseConfig()
    georef: GeorefConfig = GeorefConfig()
    undistort: UndistortConfig = UndistortConfig()
    initialize: InitializeConfig = InitializeConfig()
    train: TrainConfig = TrainConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    export: ExportConfig = ExportConfig()
    flythrough: FlythroughConfig = FlythroughConfig()
