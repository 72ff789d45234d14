"""Names of the files in a run folder that several parts of the program use (docs/files.md)."""

APPEARANCE = "appearance.npy"
