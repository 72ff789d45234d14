"""Judging a finished fit: photographs, radiance, seams, steadiness."""
