"""train: optimises the Gaussians against the photos; see ``loop``."""

from splatpipe.stages.train.loop import run

__all__ = ["run"]
