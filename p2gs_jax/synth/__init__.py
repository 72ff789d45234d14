"""The procedural street: a scene folder with linear HDR truth, rendered by the paper's rig."""

from p2gs_jax.synth.write import StreetTruth, read_truth, write_street

__all__ = ["StreetTruth", "read_truth", "write_street"]
