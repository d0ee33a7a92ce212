"""train: optimises the Gaussians against the photos; see ``loop``."""

from splatpipe.pipeline.train.loop import run

__all__ = ["run"]
