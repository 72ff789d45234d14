"""Sources of observations of shared points.

`points` are those of a scene or of a finished fit, `stack` is for photographs of one viewpoint, and
`sampling` reads the colours.
"""
