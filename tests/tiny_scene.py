"""Scenes that are small enough to fit or to evaluate in seconds."""

import cv2
import numpy as np
from PIL import Image

from p2gs_jax import initialise, solve_exposures, survey
from p2gs_jax.run.photometry_files import OF_VIEWS, write_photometry
from p2gs_jax.types import Scene, View


def make_scene(root, views=6, points=150, size=(112, 100), seed=0):
    """Write a COLMAP text model and images of discs: cameras in a row, random exposures."""
    rng = np.random.default_rng(seed)
    width, height = size
    focal = 90.0
    xyz = np.concatenate([rng.uniform(-1.5, 1.5, (points, 2)), rng.uniform(3, 6, (points, 1))], 1)
    color = rng.uniform(0.05, 0.9, (points, 3))
    e = np.exp2(rng.normal(0, 0.5, views))
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    observations = {p: [] for p in range(points)}
    lines = []
    for v in range(views):
        t = np.array([0.5 - v / (views - 1), 0.0, 0.0])
        image = np.full((height, width, 3), 0.2 * e[v])
        found = []
        local = xyz + t
        uv = local[:, :2] / local[:, 2:] * focal + [width / 2, height / 2]
        for p in np.argsort(-local[:, 2]):
            if 3 < uv[p, 0] < width - 3 and 3 < uv[p, 1] < height - 3:
                center = tuple(round(c * 16 - 8) for c in uv[p])
                cv2.circle(image, center, 3 * 16, (e[v] * color[p]).tolist(), -1, cv2.LINE_AA, 4)
                observations[p].append((v + 1, len(found)))
                found.append(f"{uv[p, 0]:.4f} {uv[p, 1]:.4f} {p + 1}")
        encoded = np.clip(image, 0, 1) ** (1 / 2.2)
        cv2.imwrite(
            str(root / "images" / f"{v}.png"), np.rint(encoded * 255).astype(np.uint8)[..., ::-1]
        )
        lines += [f"{v + 1} 1 0 0 0 {t[0]} {t[1]} {t[2]} 1 {v}.png", " ".join(found)]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n"
    )
    rows = []
    for p, track in observations.items():
        rgb = " ".join(str(int(255 * c ** (1 / 2.2))) for c in color[p])
        pairs = " ".join(f"{i} {k}" for i, k in track)
        rows.append(f"{p + 1} {xyz[p, 0]} {xyz[p, 1]} {xyz[p, 2]} {rgb} 0.5 {pairs}")
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return root


def rewrite(root, suffix, write, folder=""):
    """Give the photographs of a scene another format; `write` gets a path and an image."""
    listed = root / "sparse" / "0" / "images.txt"
    text = listed.read_text()
    (root / "images" / folder).mkdir(exist_ok=True)
    for path in sorted((root / "images").glob("*.png")):
        target = root / "images" / folder / f"{path.stem}{suffix}"
        with Image.open(path) as image:
            write(target, image)
        if target != path:
            path.unlink()
        text = text.replace(path.name, f"{folder}{target.name}")
    listed.write_text(text)
    return root


def write_solved(path, views, curve="srgb", **fields):
    """Write a photometry.json; what a view lacks is null."""
    fields = {"model": "view_exposure", "gauge": "", **fields}
    fields.setdefault("mean", {"exposure": 1.25, "exposure_geometric": 1.0, "gamma": 2.2})
    views = [dict.fromkeys(OF_VIEWS) | view for view in views]
    curve = {"name": curve, "pivot": 0.18, "spline": None}
    write_photometry(path, views=views, curve=curve, **fields)


def prepared(scene, cfg, kept=None):
    """Return the initial state of a fit of a scene, with solved exposures."""
    found = survey(scene, cfg)
    exposures = solve_exposures(scene, found.still, cfg, dense=found.dense, kept=kept)
    return initialise(found, exposures)


def noise_scene(folder, train, held_out, masked=False):
    """Write images of noise, 40x34 pixels; return their scene. `masked` leaves out left halves."""
    rng, views = np.random.default_rng(0), []
    K = np.array([[40, 0, 20], [0, 40, 17], [0, 0, 1]], np.float32)
    for name in (*train, *held_out):
        path, mask = folder / name, folder / f"{name}.mask.png" if masked else None
        cv2.imwrite(str(path), rng.integers(0, 256, (34, 40, 3), np.uint8))
        if mask is not None:
            shown = np.full((34, 40), 255, np.uint8)
            shown[:, :20] = 0
            cv2.imwrite(str(mask), shown)
        split, pose = "train" if name in train else "test", np.eye(4, dtype=np.float32)
        views.append(View(name, path, "0", pose, K, 40, 34, split=split, mask_path=mask))
    points = np.zeros((0, 3), np.float32)
    return Scene(folder, "colmap", tuple(views), points, points.astype(np.uint8))


def contents(root):
    """Return the bytes of all files below a folder, and False for its folders."""
    return {path: path.is_file() and path.read_bytes() for path in root.rglob("*")}
