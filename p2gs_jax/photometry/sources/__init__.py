"""Where observations of shared points come from."""
