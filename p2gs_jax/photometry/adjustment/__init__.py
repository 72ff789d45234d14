"""Photometric bundle adjustment: exposures, gammas and a response from colours of shared points.

Model, in logarithms relative to the pivot x0 (mid-grey): F(I) - log x0 = a_v (h_v + l_p) + noise,
with h the log exposure, l the log radiance of a point and channel, a = 2.2 / gamma, and F the log
response (`response.py`). With b = a h this is b_v + a_v l_p: linear except for the product a l.
Point radiances are eliminated exactly (variable projection). The Schur complement over the views
remains. Its entries are sums over pairs of observations of a point, so that cost and memory grow
with those pairs, never with points times views.

`problem` prepares observations; `parameters` defines the unknowns, free directions and priors.
`equations` weighs observations and assembles sums from `matrices`, and `solve` repeats both until
convergence. `errors` computes standard errors, and `fit` returns a solution.

Everything runs on the host, in numpy: derivatives are explicit, and compiling took longer than it
saved (BUILD_NOTES, "Compile less, outside the step").
"""
