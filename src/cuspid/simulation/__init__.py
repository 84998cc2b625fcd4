"""Images of a jaw as the handpiece would take them."""
