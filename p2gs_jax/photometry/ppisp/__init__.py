"""PPISP, a camera that is learned beside the splats (Deutsch et al., arXiv 2601.18336).

Radiance passes an exposure per view, vignetting per camera and channel, a homography of
chromaticities per view, and a response per camera and channel, in this order. Formulas, constants
and weights are those of the paper and of its reference implementation (github.com/nv-tlabs/ppisp,
1.2); where the two differ, of the latter.
"""
