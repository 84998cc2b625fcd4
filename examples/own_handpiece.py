"""Design a handpiece of two cameras in Python and write it for `cuspid run --handpiece` and for COLMAP.

python examples/own_handpiece.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.pairing import stereo_pairs
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig

folder = Path(sys.argv[1])
camera = Camera.from_field_of_view(640, 480, 70.0)
# Rig frame: on the surface under the probe, +X along the arch, +Z out of the gum. The cameras look down from 6 mm.
looking_down = np.diag([1.0, -1.0, -1.0])
cameras = {
    name: MountedCamera(camera, Rigid3(looking_down, -looking_down @ np.array([x, 0.0, 6.0])))
    for name, x in (("left", -1.0), ("right", 1.0))
}
led = Light(position_mm=np.array([0.0, 1.5, 6.0]), direction=np.array([0.0, 0.0, -1.0]))
handpiece = Handpiece(
    rig=Rig(cameras),
    lights={"led": led},
    lightings=(Lighting(name="all", lights=("led",)),),
    working_distance_mm=6.0,
    depth_range_mm=(3.0, 10.0),
    name="two cameras, 2 mm apart",
)
storage.write_handpiece(folder / "handpiece.json", handpiece)
storage.write_rig_config(folder / "rig_config.json", handpiece.rig)
print(f"stereo pairs: {stereo_pairs(handpiece.rig, handpiece.working_distance_mm)}")
print(f"overlap at the working distance: {handpiece.rig.overlap('left', 'right', 6.0):.0%}")
