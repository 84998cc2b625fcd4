"""A mesh against its reference: registration from any pose, and trueness in both directions."""
