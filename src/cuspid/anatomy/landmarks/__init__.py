"""Named points of a jaw: their scheme, where they are on a surface, and the dimensions measured between them."""
