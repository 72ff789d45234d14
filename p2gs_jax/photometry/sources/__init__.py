"""Where observations of shared points come from.

`points` of a scene or of a finished fit, `stack` for photographs of one viewpoint; `sampling` reads
the colours.
"""
