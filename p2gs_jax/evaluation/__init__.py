"""Evaluation of a finished fit: image scores, radiance, seams, consistency of videos."""
