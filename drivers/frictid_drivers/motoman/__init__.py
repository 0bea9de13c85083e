"""MOTOMAN-class controllers on a serial line: host control, batch jobs, streaming."""
