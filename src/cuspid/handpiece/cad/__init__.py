"""The body of a handpiece as a solid that can be printed."""
