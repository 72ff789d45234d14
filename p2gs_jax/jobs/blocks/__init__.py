"""A scene fitted in blocks; each block is a job."""
