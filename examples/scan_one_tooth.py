"""Scan the top of one tooth of the built-in phantom with four cameras, reconstruct it, and print how true the mesh is.

python examples/scan_one_tooth.py FOLDER
"""

import sys
from pathlib import Path

from cuspid import pipeline
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.visibility import VisibilityOptions

folder = Path(sys.argv[1])

jaw = build_phantom(PhantomOptions(arch="lower", edge_mm=0.5))  # the default, 0.2 mm, takes longer to make
handpiece = DESIGNS["four"](DesignOptions(width_px=240, height_px=240))  # the default, 500 px, takes thrice the time
path = ScanPathOptions(tooth=46, frames=5, length_mm=4)  # the middle of it; the default is all of it
capture, truth = pipeline.simulate(jaw, handpiece, folder, pipeline.SimulationOptions(path=path))

reconstruction, mesh = pipeline.reconstruct(capture, folder, pipeline.ReconstructionOptions())
print(f"located {len(reconstruction.frames)} of {len(capture.frames)} frames; the mesh has {len(mesh.faces):,} faces")

seen = pipeline.scannable(truth, VisibilityOptions())
trueness = pipeline.evaluate(mesh, truth.jaw, EvaluationOptions(), scannable=seen)
print(f"mean absolute deviation {trueness.accuracy.mean_abs_um:.1f} um, P95 {trueness.accuracy.p95_um:.1f} um")
print(f"{trueness.completeness_pct['50']:.1f} % of what two cameras could see lies within 50 um of the mesh")
