"""The population: where it begins, how it grows, what it is exported as."""
