"""A step of several views, on one device or on a mesh of them: (views, Gaussians)."""
