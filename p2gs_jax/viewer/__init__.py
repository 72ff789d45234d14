"""`p2gs-jax view`: a run, rendered live in the browser at any exposure."""
