"""cuspid: passive intra-oral 3D scanning, from the design of the handpiece to a mesh that can be trusted.

    handpiece            = build_handpiece("twelve")               or design(read_brief("brief.toml")).handpiece
    capture, truth       = simulate(jaw, handpiece, "scan")        or read_capture("capture")
    reconstruction, mesh = reconstruct(capture, "scan")
    trueness             = evaluate(mesh, truth)
    (panorama, *_)       = stitch(read_sequence("frames"))

What is here (``__init__.pyi``) is loaded when it is first used:
"""

from importlib import import_module

import lazy_loader

from cuspid.runtime.display import draw_with, view_with

__version__ = "0.3.0.dev0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
draw_with(lambda value: import_module("cuspid.report.notebook").to_html(value))
view_with(lambda value, port: import_module("cuspid.report.live_view").show_value(value, port))
