"""Rendering of many images in one process; scenes of the same structure share kernels."""

from pathjax.batch.jobs import Job, read
from pathjax.batch.run import Outcome, render_batch

__all__ = ["Job", "Outcome", "read", "render_batch"]
