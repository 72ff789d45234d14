"""Photometry: how photographs come from radiance, and what is solved from their colours.

Image formation (`formation`, `response`, `appearance` with `ppisp` and `luminance`, `display`)
takes radiance to pictures and back. `sources` yield `observations` of shared points; `calibrate`
chooses what varies (`models`, `candidates`) and solves it (`adjustment`) into a
`solution`, of which `unmodelled` says what it leaves. A fit starts from its `parameters`.
`metering` gives exposures to pictures that nobody took.
"""
