"""A scene fitted in blocks, of which each is a job."""
