"""Sources of observations of shared points.

`points` are points of a scene or of a finished fit, `stack` pixels of one viewpoint's photographs.
`sampling` reads their colours, for `points` over `patches` of surface.
"""
