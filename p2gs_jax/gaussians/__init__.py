"""The Gaussians: initialisation, growth, and conversion to display colours."""
