"""cuspid: passive intra-oral 3D scanning, from the design of the handpiece to a mesh that can be trusted."""

__version__ = "0.2.0"
