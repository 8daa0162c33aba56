"""COLMAP's bundle adjustment of given sightings, as JSON: `colmap_lens.py ORDERS.json SAID.json`, with peers' Python.

Orders: `size` (width, height); `params` of an OPENCV camera, pixel centres at 0.5; `poses`: for each frame `turn`
(camera to world) and `centre`; `places` of the points; `frames`, `points` and `pixels` of the sightings. Said: the
camera's `params`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap

orders = json.loads(Path(sys.argv[1]).read_text())
frames, points, pixels = (np.array(orders[name]) for name in ("frames", "points", "pixels"))
width, height = orders["size"]
made = pycolmap.Reconstruction()
camera = pycolmap.Camera(model="OPENCV", width=width, height=height, params=orders["params"], camera_id=1)
made.add_camera_with_trivial_rig(camera)
for number, pose in enumerate(orders["poses"]):
    turn = np.array(pose["turn"]).T
    image = pycolmap.Image(
        name=f"{number}", camera_id=1, image_id=number + 1,
        points2D=pycolmap.Point2DList([pycolmap.Point2D(at) for at in pixels[frames == number]]),
    )  # fmt: skip
    made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ pose["centre"]))
order = np.zeros(len(frames), dtype=int)  # of each sighting within its picture
for number in range(len(orders["poses"])):
    order[frames == number] = np.arange((frames == number).sum())
for number, place in enumerate(orders["places"]):
    track = pycolmap.Track()
    for n in np.flatnonzero(points == number):
        track.add_element(int(frames[n]) + 1, int(order[n]))
    if track.length() > 1:
        made.add_point3D(np.array(place), track, np.zeros(3, dtype=np.uint8))
options = pycolmap.BundleAdjustmentOptions()
options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
options.print_summary = False
pycolmap.bundle_adjustment(made, options)
said = {"params": made.cameras[1].params.tolist(), "error_px": made.compute_mean_reprojection_error()}
Path(sys.argv[2]).write_text(json.dumps(said))
