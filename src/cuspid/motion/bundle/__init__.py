"""All poses and points at once, with what is known of the calibration, and how far off they may be."""
