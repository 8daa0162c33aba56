"""What pycolmap reads of a model, as JSON: `colmap_reader.py ORDERS.json SAID.json`, in the peers' environment.

Orders: `model` (its folder); optional `images` and `names` (pictures whose priors are read, into `database`); optional
`pairs`: `names` of two pictures and `points`, a list of ((x, y), (x, y)) in pixels, to be triangulated; `triangulated`
(the folder of a model with points), of which the points that the picture `first` shows are told.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

orders = json.loads(Path(sys.argv[1]).read_text())
model = pycolmap.Reconstruction(orders["model"])
images = {image.name: image for image in model.images.values()}
said: dict[str, Any] = {
    "counts": [model.num_rigs(), model.num_cameras(), model.num_frames(), model.num_images()],
    "images": {},
    "priors": [],
    "points": [],
}
for name, image in images.items():
    pose, camera = image.cam_from_world().inverse(), image.camera
    said["images"][name] = {
        "turn": pose.rotation.matrix().tolist(),
        "centre": pose.translation.tolist(),
        "size": [camera.width, camera.height],
        "focal_px": [camera.focal_length_x, camera.focal_length_y],
    }
if "images" in orders:
    pycolmap.Database.open(orders["database"]).close()
    pycolmap.import_images(orders["database"], orders["images"], image_names=orders["names"])
    with pycolmap.Database.open(orders["database"]) as database:
        said["priors"] = [one.position.ravel().tolist() for one in database.read_all_pose_priors()]
if "pairs" in orders:
    pair = [images[name] for name in orders["pairs"]["names"]]
    poses, cameras = [one.cam_from_world() for one in pair], [one.camera for one in pair]

    def shown(at: np.ndarray) -> np.ndarray:
        """Where both pictures show a point, (4,)."""
        return np.concatenate([c.img_from_cam(p * at) for p, c in zip(poses, cameras, strict=True)])

    for points in orders["pairs"]["points"]:
        seen = np.array(points)
        met = pycolmap.estimate_triangulation(seen, poses, cameras)
        if met is None:  # the rays don't meet before the cameras: another place that looks alike
            said["points"].append({"at": [], "miss_px": sys.float_info.max, "slopes": []})
            continue
        at = met["xyz"]
        slopes = [(shown(at + step) - shown(at - step)) / 2e-3 for step in 1e-3 * np.eye(3)]
        miss = float(np.abs(shown(at) - seen.ravel()).max())
        said["points"].append({"at": at.tolist(), "miss_px": miss, "slopes": np.stack(slopes, axis=1).tolist()})
if "triangulated" in orders:
    made = pycolmap.Reconstruction(orders["triangulated"])
    said["tracks"] = []
    for point in made.points3D.values():
        shown_in = [(made.images[one.image_id], one.point2D_idx) for one in point.track.elements]
        places = {image.name: image.points2D[index].xy.tolist() for image, index in shown_in}
        if orders["first"] in places:
            by = [(image.cam_from_world(), image.camera) for image, _ in shown_in]

            def projected(at: np.ndarray, by: list[Any] = by) -> np.ndarray:
                return np.concatenate([camera.img_from_cam(pose * at) for pose, camera in by])

            steps = 1e-3 * np.eye(3)
            slopes = [(projected(point.xyz + step) - projected(point.xyz - step)) / 2e-3 for step in steps]
            one = {"at": point.xyz.tolist(), "place": places[orders["first"]], "images": len(places)}
            said["tracks"].append({**one, "error_px": point.error, "slopes": np.stack(slopes, axis=1).tolist()})
Path(sys.argv[2]).write_text(json.dumps(said))
