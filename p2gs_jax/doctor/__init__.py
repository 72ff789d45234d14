"""Checks of this machine; every library is imported inside a check, as it may be broken."""
