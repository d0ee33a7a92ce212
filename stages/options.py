"""All options of the line, one section per stage; each package defines its own. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.edit.options import CleanConfig
from splatpipe.pipeline.engine.stage import StageConfig
from splatpipe.pipeline.film.options import FlythroughConfig
from splatpipe.pipeline.mvs.options import DepthsConfig, InitializeConfig
from splatpipe.pipeline.photos.options import IngestConfig, SplitConfig, UndistortConfig
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig, SparseConfig
from splatpipe.pipeline.surface.options import CloudConfig, DsmConfig, DtmConfig, FacadesConfig, MeshConfig, OrthoConfig
from splatpipe.pipeline.survey.options import ControlConfig, GeorefConfig, TargetsConfig
from splatpipe.pipeline.train.blocks.options import BlocksConfig
from splatpipe.pipeline.train.options import SplatDepthsConfig, TrainConfig
from splatpipe.pipeline.web.options import ExportConfig, PublishConfig


class LineConfig(StageConfig):
    """Everything that affects the results, one section per stage."""

    ingest: IngestConfig = IngestConfig()
    control: ControlConfig = ControlConfig()
    features: FeaturesConfig = FeaturesConfig()
    matches: MatchesConfig = MatchesConfig()
    sparse: SparseConfig = SparseConfig()
    targets: TargetsConfig = TargetsConfig()
    georef: GeorefConfig = GeorefConfig()
    undistort: UndistortConfig = UndistortConfig()
    split: SplitConfig = SplitConfig()
    initialize: InitializeConfig = InitializeConfig()
    blocks: BlocksConfig = BlocksConfig()
    train: TrainConfig = TrainConfig()
    clean: CleanConfig = CleanConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    export: ExportConfig = ExportConfig()
    flythrough: FlythroughConfig = FlythroughConfig()
    depths: DepthsConfig = DepthsConfig()
    splat_depths: SplatDepthsConfig = SplatDepthsConfig()
    dsm: DsmConfig = DsmConfig()
    dtm: DtmConfig = DtmConfig()
    ortho: OrthoConfig = OrthoConfig()
    facades: FacadesConfig = FacadesConfig()
    cloud: CloudConfig = CloudConfig()
    mesh: MeshConfig = MeshConfig()
    publish: PublishConfig = PublishConfig()
