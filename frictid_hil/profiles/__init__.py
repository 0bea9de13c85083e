"""The profile store: every profile that a robot had, which one is active, and how its friction drifted."""
