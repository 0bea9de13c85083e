"""Where the sim-to-real gap lies, which effect causes it, how far it shrinks; the blind check of all that."""
