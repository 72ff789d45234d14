"""`p2gs-jax view`: a finished run, rendered live in the browser at any exposure."""
