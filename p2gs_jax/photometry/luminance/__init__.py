"""Luminance-GS (Cui, Chu and Harada, CVPR 2025): a colour matrix and a curve per photograph."""
