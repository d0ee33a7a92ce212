"""splatpipe as a library: from photos to a georeferenced splat, from scripts and notebooks (docs/library.md).

The names in ``__all__`` are public and stable (docs/api.md); all modules are private. Nothing is loaded until it is
used.

This file is installed as ``splatpipe/__init__.py`` (pyproject.toml, ``tool.scikit-build.wheel.packages``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpipe.pipeline.app.library.captures import run_capture, run_stage
    from splatpipe.pipeline.app.library.fits import fit_similarity
    from splatpipe.pipeline.app.library.run import Render, Run, SparsePoints, look_at, open_run
    from splatpipe.pipeline.app.library.splats import Splat, read_splat, write_splat
    from splatpipe.pipeline.engine.errors import SplatpipeError
    from splatpipe.pipeline.engine.events import Event
    from splatpipe.pipeline.geometry.alignment import SimilarityFit
    from splatpipe.pipeline.geometry.camera import Camera
    from splatpipe.pipeline.geometry.similarity import Similarity
    from splatpipe.pipeline.raster.fused_adam import FusedAdam
    from splatpipe.pipeline.raster.fused_ssim import fused_ssim
    from splatpipe.pipeline.raster.rasterization import rasterization
    from splatpipe.pipeline.splat.model.scene import SplatOrigin

    __version__: str

_MODULES = {
    "Camera": "geometry.camera",
    "Event": "engine.events",
    "FusedAdam": "raster.fused_adam",
    "Render": "app.library.run",
    "Run": "app.library.run",
    "Similarity": "geometry.similarity",
    "SimilarityFit": "geometry.alignment",
    "SparsePoints": "app.library.run",
    "Splat": "app.library.splats",
    "SplatOrigin": "splat.model.scene",
    "SplatpipeError": "engine.errors",
    "fit_similarity": "app.library.fits",
    "fused_ssim": "raster.fused_ssim",
    "look_at": "app.library.run",
    "open_run": "app.library.run",
    "rasterization": "raster.rasterization",
    "read_splat": "app.library.splats",
    "run_capture": "app.library.captures",
    "run_stage": "app.library.captures",
    "write_splat": "app.library.splats",
}
"""The module below ``splatpipe.pipeline`` that defines each public name."""

__all__ = [
    "Camera",
    "Event",
    "FusedAdam",
    "Render",
    "Run",
    "Similarity",
    "SimilarityFit",
    "SparsePoints",
    "Splat",
    "SplatOrigin",
    "SplatpipeError",
    "__version__",
    "fit_similarity",
    "fused_ssim",
    "look_at",
    "open_run",
    "rasterization",
    "read_splat",
    "run_capture",
    "run_stage",
    "write_splat",
]


if not TYPE_CHECKING:  # or else type checkers accept any name

    def __getattr__(name: str) -> Any:
        """Load a public name when it is first used."""
        import importlib

        if name == "__version__":
            import importlib.metadata

            value: Any = importlib.metadata.version("splatpipe")
        elif name in _MODULES:
            value = getattr(importlib.import_module(f"splatpipe.pipeline.{_MODULES[name]}"), name)
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return __all__
