"""Chapter 4 of the thesis as it is written: the baseline for the method ``ortho``."""
