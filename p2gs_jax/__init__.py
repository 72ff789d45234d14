"""P2GS in JAX."""
