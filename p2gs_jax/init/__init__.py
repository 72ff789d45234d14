"""From seed points to Gaussians: what a fit starts from."""
