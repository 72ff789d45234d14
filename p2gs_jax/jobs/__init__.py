"""Long jobs on an engine that exists: local processes, Dask, or Slurm through submitit."""

from p2gs_jax.jobs.engines import open_engine
from p2gs_jax.jobs.job import REASON, Job, JobState
from p2gs_jax.jobs.run import run_jobs

__all__ = ["REASON", "Job", "JobState", "open_engine", "run_jobs"]
