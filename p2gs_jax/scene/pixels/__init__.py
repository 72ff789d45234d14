"""Decoded photographs, whatever their number: in memory where all fit, else in mapped files."""
