"""Initial Gaussians: from points, from dense depth, and a far shell."""
