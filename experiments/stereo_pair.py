"""A scene of the real stereo pair "Motorcycle", whose pictures may be shown.

python experiments/stereo_pair.py LEFT RIGHT --out SCENE

The pair is one of the Middlebury 2014 stereo benchmark (Scharstein et al. 2014), at a quarter of
its width, as scikit-image distributes it under its BSD licence: `skimage/data/motorcycle_left.png`
and `motorcycle_right.png` in its wheels up to 0.17. The calibration is that of its documentation.

    p2gs-jax fit SCENE --out RUN --steps 800 --data.test-every 0
    p2gs-jax export RUN --format html --photographs 2
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np

# In pixels, but for the baseline. The centre of the right photograph lies farther to the right.
FOCAL, CENTRE, RIGHT_CX_SHIFT, BASELINE_M = 994.978, (311.193, 254.877), 31.086, 0.193001


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photographs", type=Path, nargs=2, metavar="FILE", help="left and right")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    images = args.out / "images"
    images.mkdir(parents=True)
    frames = []
    for k, photograph in enumerate(args.photographs):
        shutil.copyfile(photograph, images / photograph.name)
        picture = cv2.imread(str(photograph))
        if picture is None:
            raise SystemExit(f"{photograph} cannot be decoded.")
        height, width = picture.shape[:2]
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[0, 3] = k * BASELINE_M
        frames.append(
            {
                "file_path": f"images/{photograph.name}",
                "transform_matrix": pose.tolist(),
                "w": width,
                "h": height,
                "fl_x": FOCAL,
                "fl_y": FOCAL,
                "cx": CENTRE[0] + k * RIGHT_CX_SHIFT,
                "cy": CENTRE[1],
            }
        )
    (args.out / "transforms.json").write_text(json.dumps({"frames": frames}, indent=1))


if __name__ == "__main__":
    main()
