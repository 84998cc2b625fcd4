"""Pages of one file, which open from a disk without a network."""
