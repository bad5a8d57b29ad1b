"""Many images in one process: data sets of scenes, which share kernels where their structure is the same."""

from pathjax.batch.jobs import Job, read
from pathjax.batch.run import Outcome, render_batch

__all__ = ["Job", "Outcome", "read", "render_batch"]
