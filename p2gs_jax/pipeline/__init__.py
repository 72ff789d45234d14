"""From a scene folder to a run folder, and photometry without splatting."""
