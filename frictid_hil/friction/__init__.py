"""The paper as pure functions on arrays: no I/O, no clocks, no hardware."""
