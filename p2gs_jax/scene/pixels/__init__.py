"""Decoded photographs, whatever their number: in memory where all fit, else in mapped files.

`decode` makes pixels of a file; `held` is what callers ask: it keeps what was used last, up to a
bound; `files` holds what does not fit, so that nothing is decoded twice.
"""
