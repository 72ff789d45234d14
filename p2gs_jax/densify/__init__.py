"""How the population of Gaussians grows and moves."""
