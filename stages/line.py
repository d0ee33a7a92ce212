"""The pipeline from photos to splat: every stage's contract, in order. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.edit.options import CleanConfig
from splatpipe.pipeline.engine.stage import NamedFile, Shards, Stage
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

INGEST = Stage(
    "ingest",
    version=8,
    config=IngestConfig,
    reads=("source.photos", "source.geo", "source.lens"),
    parts={
        "photos": "photos",
        "cameras": "cameras.json",
        "lenses": "lenses.json",
        "positions": "positions.json",
        "left_out": "left_out.json",
    },
    entry="splatpipe.stages.ingest:run",
    borrows=("georef.approximate_crs",),
    files={
        "positions": NamedFile("source.geo", ("geo.txt", "positions.csv")),
        "lens": NamedFile("source.lens", ("lens.xml", "lens.txt", "lens.cam")),
    },
    resumable=True,
)
FEATURES = Stage(
    "features",
    version=1,
    config=FeaturesConfig,
    reads=("ingest.photos", "ingest.cameras"),
    parts={"database": "database.db", "colours": "colours.npy"},
    entry="splatpipe.stages.features:run",
)
MATCHES = Stage(
    "matches",
    version=3,
    config=MatchesConfig,
    reads=("features.database", "ingest.photos", "ingest.positions"),
    parts={"database": "database.db", "pairs": "pairs.json"},
    entry="splatpipe.stages.matches:run",
)
SPARSE = Stage(
    "sparse",
    version=15,
    config=SparseConfig,
    reads=(
        "matches.database",
        "matches.pairs",
        "features.database",
        "features.colours",
        "ingest.photos",
        "ingest.positions",
        "ingest.cameras",
        "ingest.lenses",
    ),
    parts={"model": "sparse/0", "summary": "models.json"},
    entry="splatpipe.stages.sparse:run",
)
CONTROL = Stage(
    "control",
    version=1,
    config=ControlConfig,
    reads=("source.control", "source.scale_bars"),
    parts={"points": "points.json"},
    entry="splatpipe.stages.control:run",
    files={"scale_bars": NamedFile("source.scale_bars", ("scale_bars.csv",))},
)
TARGETS = Stage(
    "targets",
    version=4,
    config=TargetsConfig,
    reads=("control.points", "sparse.model", "ingest.photos", "ingest.positions"),
    parts={"found": "targets.json"},
    entry="splatpipe.stages.targets:run",
    borrows=("georef.max_position_error_m", "georef.approximate_crs"),
)
GEOREF = Stage(
    "georef",
    version=15,
    config=GeorefConfig,
    reads=(
        "sparse.model",
        "ingest.positions",
        "ingest.photos",
        "ingest.cameras",
        "ingest.lenses",
        "control.points",
        "targets.found",
        "source.control",
        "source.boundary",
    ),
    parts={
        "frame": "frame.json",
        "model": "sparse/0",
        "control": "control.json",
        "accuracy": "accuracy.json",
        "boundary": "boundary.json",
    },
    entry="splatpipe.stages.georef:run",
    borrows=("sparse.lens",),
    files={
        "control": NamedFile("source.control", ("gcp_list.txt", "control.csv")),
        "boundary": NamedFile("source.boundary", ("boundary.geojson",)),
    },
)
UNDISTORT = Stage(
    "undistort",
    version=3,
    config=UndistortConfig,
    reads=("georef.model", "ingest.photos"),
    parts={"dataset": "dataset"},
    entry="splatpipe.stages.undistort:run",
)
SPLIT = Stage(
    "split",
    version=1,
    config=SplitConfig,
    reads=("undistort.dataset",),
    parts={"views": "split.json"},
    entry="splatpipe.stages.split:run",
)
INITIALIZE = Stage(
    "initialize",
    version=7,
    config=InitializeConfig,
    reads=("undistort.dataset", "split.views", "georef.boundary"),
    parts={"splat": "init.ply"},
    entry="splatpipe.stages.initialize:run",
)
BLOCKS = Stage(
    "blocks",
    version=10,
    config=BlocksConfig,
    reads=("undistort.dataset", "split.views", "initialize.splat", "georef.boundary"),
    parts={"plan": "blocks.json", "coarse": "coarse", "prospects": "prospects"},
    entry="splatpipe.stages.blocks:run",
    borrows=tuple(f"train.{name}" for name in TrainConfig.model_fields),
    resumable=True,
)
TRAIN = Stage(
    "train",
    version=16,
    config=TrainConfig,
    reads=(
        "undistort.dataset",
        "split.views",
        "initialize.splat",
        "georef.boundary",
        "blocks.plan",
        "blocks.coarse",
        "blocks.prospects",
    ),
    parts={
        "model": "model.ply",
        "history": "history.json",
        "plan": "plan.json",
        "rendering": "rendering.json",
        "exposures": "exposures.json",
        "sky": "sky.npz",
    },
    entry="splatpipe.stages.train:run",
    resumable=True,
    shards=Shards(
        counted_by="blocks.plan",
        parts={"model": "model.ply", "history": "history.json", "plan": "plan.json"},
        entry="splatpipe.stages.train:run_block",
        resumable=True,
    ),
)
CLEAN = Stage(
    "clean",
    version=4,
    config=CleanConfig,
    reads=("train.model", "train.rendering", "train.sky", "undistort.dataset", "split.views"),
    parts={"model": "model.ply", "told": "cleaned.json"},
    entry="splatpipe.stages.clean:run",
)
EVALUATE = Stage(
    "evaluate",
    version=13,
    config=EvaluateConfig,
    reads=(
        "clean.model",
        "train.rendering",
        "train.sky",
        "undistort.dataset",
        "split.views",
        "georef.frame",
        "georef.control",
        "georef.accuracy",
        "georef.boundary",
    ),
    parts={"metrics": "metrics.json", "views": "views"},
    entry="splatpipe.stages.evaluate:run",
)
EXPORT = Stage(
    "export",
    version=12,
    config=ExportConfig,
    reads=(
        "clean.model",
        "train.rendering",
        "train.sky",
        "georef.frame",
        "georef.model",
        "georef.boundary",
        "undistort.dataset",
        "evaluate.metrics",
        "ingest.photos",
        "ingest.left_out",
    ),
    parts={
        "splat": "splat.ply",
        "georef": "georef.json",
        "cameras": "cameras.json",
        "metrics": "metrics.json",
        "sparse": "sparse.glb",
        "sky": "sky",
        "viewer": "viewer",
        "formats": "formats",
    },
    entry="splatpipe.stages.export:run",
    deliverables=("splat", "georef", "cameras", "metrics", "sparse", "sky", "viewer", "formats"),
)

FLYTHROUGH = Stage(
    "flythrough",
    version=4,
    config=FlythroughConfig,
    reads=("clean.model", "train.rendering", "train.sky", "undistort.dataset"),
    parts={"film": "film"},
    entry="splatpipe.stages.flythrough:run",
    borrows=("train.time_budget_s",),
    deliverables=("film",),
)

DEPTHS = Stage(
    "depths",
    version=3,
    config=DepthsConfig,
    reads=("undistort.dataset",),
    parts={"maps": "maps"},
    entry="splatpipe.stages.depths:run",
    resumable=True,
)
SPLAT_DEPTHS = Stage(
    "splat_depths",
    version=1,
    config=SplatDepthsConfig,
    reads=(
        "clean.model",
        "train.rendering",
        "train.sky",
        "train.exposures",
        "blocks.plan",
        "undistort.dataset",
        "split.views",
    ),
    parts={"maps": "maps"},
    entry="splatpipe.stages.splat_depths:run",
    borrows=("depths.max_megapixels",),
    resumable=True,
)
SURFACE_READS = (
    "depths.maps",
    "splat_depths.maps",
    "undistort.dataset",
    "georef.frame",
    "georef.model",
    "georef.boundary",
    "ingest.photos",
)
DSM = Stage(
    "dsm",
    version=4,
    config=DsmConfig,
    reads=SURFACE_READS,
    parts={"files": "files", "site": "site.json"},
    entry="splatpipe.stages.dsm:run",
    resumable=True,
    deliverables=("files",),
)
DTM = Stage(
    "dtm",
    version=2,
    config=DtmConfig,
    reads=("dsm.files", "dsm.site", "georef.frame"),
    parts={"files": "files", "cover": "cover"},
    entry="splatpipe.stages.dtm:run",
    resumable=True,
    deliverables=("files",),
)
ORTHO = Stage(
    "ortho",
    version=3,
    config=OrthoConfig,
    reads=("dsm.files", "dsm.site", *SURFACE_READS),
    parts={"files": "files"},
    entry="splatpipe.stages.ortho:run",
    resumable=True,
    deliverables=("files",),
)
FACADES = Stage(
    "facades",
    version=2,
    config=FacadesConfig,
    reads=("dsm.site", *SURFACE_READS),
    parts={"files": "files"},
    entry="splatpipe.stages.facades:run",
    resumable=True,
    deliverables=("files",),
)
CLOUD = Stage(
    "cloud",
    version=4,
    config=CloudConfig,
    reads=("dsm.site", "dsm.files", "dtm.files", "dtm.cover", *SURFACE_READS),
    parts={"files": "files"},
    entry="splatpipe.stages.cloud:run",
    resumable=True,
    deliverables=("files",),
)
MESH = Stage(
    "mesh",
    version=4,
    config=MeshConfig,
    reads=("dsm.site", *SURFACE_READS),
    parts={"files": "files", "textured": "textured.npz"},
    entry="splatpipe.stages.mesh:run",
    resumable=True,
    deliverables=("files",),
)
PUBLISH = Stage(
    "publish",
    version=1,
    config=PublishConfig,
    reads=("georef.frame", "dsm.files", "ortho.files", "cloud.files", "mesh.files", "mesh.textured"),
    parts={"files": "files", "viewer": "viewer"},
    entry="splatpipe.stages.publish:run",
    resumable=True,
    deliverables=("files",),
)

LINE = (
    INGEST,
    CONTROL,
    FEATURES,
    MATCHES,
    SPARSE,
    TARGETS,
    GEOREF,
    UNDISTORT,
    SPLIT,
    INITIALIZE,
    BLOCKS,
    TRAIN,
    CLEAN,
    EVALUATE,
    EXPORT,
    SPLAT_DEPTHS,
    FLYTHROUGH,
    DEPTHS,
    DSM,
    DTM,
    ORTHO,
    FACADES,
    CLOUD,
    MESH,
    PUBLISH,
)

AHEAD = {
    "depths": "train",  # not earlier: features, matches and blocks go by the memory that is free
    **dict.fromkeys(("dsm", "dtm", "ortho", "facades", "cloud", "mesh", "publish"), "flythrough"),
}
"""Stages that may run ahead of their turn, each with the first stage beside which it may.

They use no graphics card, and their results do not depend on the summaries of the stages that they overtake."""
