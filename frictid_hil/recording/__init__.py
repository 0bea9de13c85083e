"""Samples in memory and on disk: what was measured, when, and by which clock."""
