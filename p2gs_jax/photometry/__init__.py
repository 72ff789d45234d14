"""Photometry: image formation, and its parameters from colours of shared points.

Image formation (`formation`, `response`, `appearance` with `ppisp` and `luminance`, `display`)
turns radiance into pictures and back. `sources` yield `observations` of shared points. `calibrate`
chooses a model and a curve (`models`, `candidates`) and solves for a `solution` (`adjustment`);
`unmodelled` examines its residuals. `parameters` holds the initial photometry of a fit. `metering`
chooses exposures of new pictures.
"""
