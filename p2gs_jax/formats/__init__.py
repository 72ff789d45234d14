"""Readers and writers of file formats that other programs know."""
