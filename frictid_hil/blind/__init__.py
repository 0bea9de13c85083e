"""The blind check: joints from a generator of its own, truth under seal, and a score."""
