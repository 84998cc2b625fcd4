"""Where the handpiece goes."""
