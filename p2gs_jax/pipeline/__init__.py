"""From a scene folder to a run folder, and the photometry alone."""
