"""Self-contained HTML pages: they open from a USB stick, offline, print well, and follow the reader's light or dark."""
