"""From samples to a joint's profile."""
