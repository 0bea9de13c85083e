"""What moves hardware: one joint at a time, every other one locked, every sample supervised."""
