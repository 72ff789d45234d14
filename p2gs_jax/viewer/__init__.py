"""`p2gs-jax view`: a finished run in the browser, rendered live at any exposure."""
