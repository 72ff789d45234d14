"""Camera paths: the scene's own views, drives, orbits, files of cameras, and panoramas of rigs."""
