"""Scan the top of one tooth of the built-in phantom with four cameras, reconstruct it, and print how true the mesh is.

python examples/scan_one_tooth.py FOLDER
"""

import sys

import cuspid


def main(folder: str) -> None:
    """Simulate, reconstruct and evaluate the scan."""
    jaw = cuspid.build_phantom(cuspid.PhantomOptions(edge_mm=0.5))  # the default, 0.2 mm, takes longer to make
    small = cuspid.DesignOptions(width_px=240, height_px=240)  # the default, 500 px, takes thrice the time
    handpiece = cuspid.build_handpiece("four", small)
    path = cuspid.ScanPathOptions(tooth=46, frames=5, length_mm=4)  # the middle of it; the default is all of it
    capture, truth = cuspid.simulate(jaw, handpiece, folder, cuspid.SimulationOptions(path=path))

    reconstruction, mesh = cuspid.reconstruct(capture, folder)
    print(
        f"located {len(reconstruction.frames)} of {len(capture.frames)} frames; the mesh has {len(mesh.faces):,} faces"
    )

    trueness = cuspid.evaluate(mesh, truth)
    print(f"mean absolute deviation {trueness.accuracy.mean_abs_um:.1f} um, P95 {trueness.accuracy.p95_um:.1f} um")
    print(f"{trueness.completeness_pct['50']:.1f} % of what two cameras could see lies within 50 um of the mesh")


if __name__ == "__main__":
    main(sys.argv[1])
