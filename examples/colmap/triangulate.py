#!/usr/bin/env python3
"""Points from the poses that `dappled batch --as colmap` wrote: COLMAP matches the pictures, poses and cameras stay.

    pip install pycolmap
    python triangulate.py products/FLIGHT/colmap [VIEW ...]

Writes database.db and triangulated/ (a COLMAP model) into that folder. With views named (v0u0 v2u2 v4u4) only those are
matched, which is faster: the time grows with the square of the number of pictures.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pycolmap

folder, views = Path(sys.argv[1]), set(sys.argv[2:])
database, images, output = folder / "database.db", folder / "images", folder / "triangulated"
model = pycolmap.Reconstruction(folder / "sparse" / "0")
if database.exists():
    sys.exit(f"{database} exists already: remove it to match again")
output.mkdir(exist_ok=True)
with pycolmap.Database.open(database) as made:  # under the model's own numbers, else COLMAP gives others
    for camera in model.cameras.values():
        made.write_camera(camera, use_camera_id=True)
    for rig in model.rigs.values():
        made.write_rig(rig, use_rig_id=True)
    for frame in model.frames.values():
        made.write_frame(frame, use_frame_id=True)
    for image in model.images.values():
        made.write_image(image, use_image_id=True)
names = sorted(image.name for image in model.images.values() if not views or image.name.partition("/")[0] in views)
pycolmap.extract_features(database, images, image_names=names)
pycolmap.match_exhaustive(database)
found = pycolmap.triangulate_points(model, database, images, output)
print(f"{found.num_points3D()} points, {found.compute_mean_reprojection_error():.2f} px rms, in {output}")
