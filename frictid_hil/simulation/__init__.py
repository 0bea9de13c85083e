"""One geared joint with its servo loop, and every physical effect defined once, one file each."""
