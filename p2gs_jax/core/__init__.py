"""Helpers for all packages: device arrays, random streams, files, clocks."""
