"""train: optimises the Gaussians against the photos; see ``pipeline.train.loop``."""

from splatpipe.pipeline.train.loop import run

__all__ = ["run"]
