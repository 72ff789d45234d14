"""The run folder: what lies in it, written and read (docs/files.md)."""
