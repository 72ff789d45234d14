"""Decoded photographs, whatever their number: in memory where all fit, else in mapped files.

`decode` makes pixels of a file; `cache` holds in files what does not fit into memory, so that
nothing is decoded twice; `store` is what callers ask: it keeps what was used last, up to a bound.
"""
