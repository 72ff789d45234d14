"""Work larger than one process: jobs on engines that exist, sweeps, scenes in blocks."""
