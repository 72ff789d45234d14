"""Gaussians before the first step: points, dense seeds, a far shell."""
