"""Camera paths: the views of a scene, drives, orbits, camera files, and panoramas of rigs."""
