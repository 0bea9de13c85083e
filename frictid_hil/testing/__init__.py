"""For people who write drivers: a wire without hardware, and what every driver must do on it."""
