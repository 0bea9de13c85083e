"""What `compensate` plans, runs and measures."""
