"""Videos as scenes: which frames are worth keeping, and these as photographs."""
