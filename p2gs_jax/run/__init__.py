"""The run folder: writing and reading its files (docs/files.md)."""
