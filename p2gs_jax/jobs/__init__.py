"""Work larger than one process: jobs on existing engines, sweeps, and scenes in blocks."""
