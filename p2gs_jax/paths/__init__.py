"""Camera paths: the scene's own views, drives, orbits, files of cameras, and panoramas of rigs."""

from p2gs_jax.paths.cylinder import Cylinder, covering
from p2gs_jax.paths.drive import PosePath, drive
from p2gs_jax.paths.files import read_cameras, write_cameras
from p2gs_jax.paths.orbit import Orbit, find_orbit, orbit
from p2gs_jax.paths.panorama import Wide, render_wide, slices, stitch
from p2gs_jax.paths.pinhole import make_camera
from p2gs_jax.paths.rig import Rig, TimeStep, find_rig
from p2gs_jax.paths.shots import Shot, of_camera, view_shots

__all__ = [
    "Cylinder",
    "Orbit",
    "PosePath",
    "Rig",
    "Shot",
    "TimeStep",
    "Wide",
    "covering",
    "drive",
    "find_orbit",
    "find_rig",
    "make_camera",
    "of_camera",
    "orbit",
    "read_cameras",
    "render_wide",
    "slices",
    "stitch",
    "view_shots",
    "write_cameras",
]
