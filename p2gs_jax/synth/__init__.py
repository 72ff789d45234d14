"""The procedural town: a scene folder with linear HDR truth, by the paper's rig and protocol."""
