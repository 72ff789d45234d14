"""SIFT features and matches in a COLMAP database, and the choice of image pairs to match.

The database of `kept_features` is cached: after an interruption, or with more photographs, only new
features and matches are computed. It is deleted if photographs are missing, or files or options
changed.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import Matching
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.colmap import pycolmap
from p2gs_jax.core.memory import left_to_process
from p2gs_jax.core.text import natural
from p2gs_jax.core.threads import available_cores
from p2gs_jax.errors import UserError
from p2gs_jax.scene.cameras import parent_of
from p2gs_jax.scene.files import Report, file_fingerprints, image_size, stage_progress
from p2gs_jax.scene.pixels.decode import BYTES_PER_PIXEL, SHARE
from p2gs_jax.scene.rigid import camera_centers

MAX_IMAGE_SIZE = 1600  # longer side for SIFT, pixels
MAX_FEATURES = 4096  # of one image
# Contrast of a photograph, the standard deviation of grey 8-bit values, below which SIFT's
# threshold falls in proportion, by halvings and at most by this number of them. On mixtures of
# exposures (LOM sofa) 33 of 33 photographs register instead of 18.
CONTRAST, MOST_HALVINGS = 60, 4
EXHAUSTIVE_LIMIT = 60
"""Every pair of up to this number of images is matched."""
DATABASE, RECORD = "database.db", "photographs.json"
# The numbers of photographs and pairs between two reports of progress.
IMAGES_AT_ONCE, PAIRS_AT_ONCE = 8, 100
_OVERLAP, _LOOPS_EVERY = 10, 5  # images (`pairs_by_name`)
# Nearest neighbours with known poses. For nerf_fox (50 views of 540x960), 20 neighbours give 574
# pairs and 11,961 points in 71 s of processor time; 10 give 292 pairs and 12,017 points in 53 s.
_NEIGHBOURS = 10
_EXHAUSTIVE_LIMIT_BY_POSE = _NEIGHBOURS + 5

# In COLMAP's lists of pairs a name ends at a blank, and # begins a comment. Private-use characters
# replace these while images are matched.
_ESCAPED = {ord(c): 0xE000 + ord(c) for c in " \t\v\f\r\n#"}
_UNESCAPED = {escaped: plain for plain, escaped in _ESCAPED.items()}

Pair = tuple[str, str]


def quiet_colmap() -> None:
    """Silence COLMAP's log: the messages of this package name its failures with their reasons."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)


def extract(
    database: Path,
    image_folder: Path,
    names: Sequence[str],
    *,
    mode: pycolmap.CameraMode,
    enlarge: bool = True,
    camera: int | None = None,
) -> None:
    """Detect SIFT features of images on the CPU and store them in a new or an existing database.

    `mode` states how images share cameras; `camera` is the id, in the database, of one camera for
    all images. With `enlarge`, features are also found at twice the size. In images of little
    contrast, such as dark ones, weaker features count. Raises UserError: COLMAP failed.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = MAX_IMAGE_SIZE
    options.sift.max_num_features = MAX_FEATURES
    if not enlarge:
        options.sift.first_octave = 0
    # COLMAP decodes a photograph in every thread.
    largest = max(w * h for w, h in (image_size(image_folder / name) for name in names))
    most_threads = int(SHARE * (left_to_process() or sys.maxsize)) // (BYTES_PER_PIXEL * largest)
    if most_threads < available_cores():
        options.num_threads = max(1, most_threads)
    reader, threshold = pycolmap.ImageReaderOptions(), options.sift.peak_threshold
    if camera is not None:
        reader.existing_camera_id = camera
    pycolmap.Database.open(database).close()
    # Images get ids by name; otherwise in the order in which threads finish, and points are
    # triangulated by ids.
    pycolmap.import_images(database, image_folder, mode, names, reader)
    halvings = [_halvings(image_folder / name) for name in names]
    for each in sorted({*halvings}):
        part = [name for name, k in zip(names, halvings, strict=True) if k == each]
        options.sift.peak_threshold = threshold * 0.5**each
        try:
            pycolmap.extract_features(
                database,
                image_folder,
                image_names=part,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        except (RuntimeError, ValueError, OSError) as error:
            why = f"COLMAP could not extract features in {image_folder}: {error}."
            fix = "find an image there that does not open, and remove or replace it"
            raise UserError(why, fix=fix) from error


def _halvings(path: Path) -> int:
    """Return how often SIFT's threshold is halved for an image, by its contrast."""
    gray = cv2.imread(str(path), cv2.IMREAD_REDUCED_GRAYSCALE_2)
    contrast = 0.0 if gray is None else float(gray.std())
    lower = np.log2(CONTRAST / contrast) if contrast > 0 else 0.0
    return int(np.clip(np.rint(lower), 0, MOST_HALVINGS))


def match(database: Path, pairs: Iterable[Pair] | None) -> None:
    """Match the features of pairs of images, by name, on the CPU; None matches every pair."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0  # -1, the default, gives other inliers in each run
    how = {"verification_options": verification, "device": pycolmap.Device.cpu}
    if pairs is None:
        pycolmap.match_exhaustive(database, **how)
        return
    listing = database.with_name("pairs.txt")
    lines = (f"{a.translate(_ESCAPED)} {b.translate(_ESCAPED)}\n" for a, b in pairs)
    listing.write_text("".join(lines), encoding="utf-8")
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listing
    _rename(database, _ESCAPED)
    try:
        pycolmap.match_image_pairs(database, pairing_options=options, **how)
    finally:
        _rename(database, _UNESCAPED)


def _rename(database: Path, characters: Mapping[int, int]) -> None:
    with pycolmap.Database.open(database) as db:
        for image in db.read_all_images():
            name = image.name.translate(characters)
            if name != image.name:
                image.name = name
                db.update_image(image)


def kept_features(
    folder: Path, image_folder: Path, groups: Mapping[tuple, Sequence[str]], report: Report
) -> Path:
    """Return the database in `folder` with the features of photographs; missing ones are computed.

    `groups` holds the names of photographs by camera. Raises UserError: COLMAP failed.
    """
    files = {}
    for key, group in groups.items():
        fingerprints = file_fingerprints([image_folder / name for name in group])
        for name, (_, size, changed) in zip(group, fingerprints, strict=True):
            files[name] = [size, changed, str(key)]
    options = [pycolmap.__version__, MAX_IMAGE_SIZE, MAX_FEATURES, CONTRAST, MOST_HALVINGS]
    record = {"options": options, "files": files}
    database = folder / DATABASE
    if not _continues(folder / RECORD, record):
        shutil.rmtree(folder, ignore_errors=True)
    write_json(folder / RECORD, record)
    names = [name for group in groups.values() for name in group]
    if database.is_file():
        # A run that was killed while it matched leaves escaped names.
        _rename(database, _UNESCAPED)
    known = _cameras(database)
    if not known:  # its images, if any, would keep their camera beside that of new ones
        database.unlink(missing_ok=True)
    new = [name for name in names if name not in known]
    if len(new) < len(names):
        report(f"features of {len(names) - len(new)} images come from an earlier run")
    progress, done = stage_progress(report, "detecting features", len(new), "images"), 0
    for group in groups.values():
        wanted = [name for name in group if name not in known]
        for start in range(0, len(wanted), IMAGES_AT_ONCE):
            part = wanted[start : start + IMAGES_AT_ONCE]
            camera = next((known[name] for name in group if name in known), None)
            extract(database, image_folder, part, mode=pycolmap.CameraMode.SINGLE, camera=camera)
            known |= _cameras(database)
            done += len(part)
            progress(done)
    return database


def match_kept(
    database: Path, names: Sequence[str], pairs: Sequence[Pair] | None, report: Report
) -> None:
    """Match those pairs (None: all pairs) that the database does not have yet."""
    wanted = list(combinations(sorted(names), 2)) if pairs is None else list(pairs)
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        known = [(a, b) for a, b in wanted if a in ids and b in ids]
        left = [(a, b) for a, b in known if not db.exists_two_view_geometry(ids[a], ids[b])]
    if len(left) < len(known):
        report(f"matches of {len(known) - len(left)} image pairs come from an earlier run")
    progress = stage_progress(report, "matching", len(left), "image pairs")
    for start in range(0, len(left), PAIRS_AT_ONCE):
        match(database, left[start : start + PAIRS_AT_ONCE])
        progress(start + PAIRS_AT_ONCE)


def _continues(path: Path, record: dict) -> bool:
    """Return whether all photographs of an earlier run are still there and unchanged."""
    try:
        old = json.loads(path.read_text())
        now = record["files"]
        return old["options"] == record["options"] and all(
            now.get(name) == was for name, was in old["files"].items()
        )
    except (OSError, ValueError, KeyError, AttributeError):
        return False


def _cameras(database: Path) -> dict[str, int]:
    """Return the camera id of every photograph with features."""
    if not database.is_file():
        return {}
    with pycolmap.Database.open(database) as db:
        images = (image for image in db.read_all_images() if db.exists_keypoints(image.image_id))
        return {image.name: image.camera_id for image in images}


def pairs_by_name(names: Sequence[str], matching: Matching = "auto") -> list[Pair] | None:
    """Return the pairs of images to match by their names alone; None means all.

    Each folder is a sequence. An image is matched with the next 10 images and those 16, 32, ... 512
    later. With `sequence`, every fifth image is matched with every other fifth, which finds loops.
    Images of different folders are matched at the same or the next position. `auto` treats long
    lists as sequences.
    """
    if matching == "all" or (matching == "auto" and len(names) <= EXHAUSTIVE_LIMIT):
        return None
    sequences: dict[str, list[str]] = defaultdict(list)
    for name in sorted(names, key=natural):
        sequences[parent_of(name)].append(name)
    steps = [*range(1, _OVERLAP + 1), *(2**k for k in range(4, 10))]
    pairs: list[Pair] = []
    lists = list(sequences.values())
    for i, a in enumerate(lists):
        near = [(k, k + s) for s in steps for k in range(len(a) - s)]
        far = combinations(range(0, len(a), _LOOPS_EVERY), 2) if matching == "sequence" else ()
        pairs += [(a[k], a[m]) for k, m in dict.fromkeys([*near, *far])]
        for b in lists[i + 1 :]:
            pairs += [
                (a[k], b[k + s]) for s in (-1, 0, 1) for k in range(len(a)) if 0 <= k + s < len(b)
            ]
    return pairs


def pairs_by_pose(names: Sequence[str], viewmats: Float[np.ndarray, "v 4 4"]) -> list[Pair] | None:
    """Return the pairs of images to match by known world-to-camera poses; None means all.

    Each image is matched with the 10 nearest cameras within 75 degrees of its viewing direction.
    """
    if len(names) <= _EXHAUSTIVE_LIMIT_BY_POSE:
        return None
    centers, directions = camera_centers(viewmats), viewmats[:, 2, :3].astype(np.float64)
    pairs: set[tuple[int, int]] = set()
    for i in range(len(names)):
        distance = np.linalg.norm(centers - centers[i], axis=1)
        distance[directions @ directions[i] < np.cos(np.radians(75.0))] = np.inf
        distance[i] = np.inf
        nearest = np.argsort(distance, kind="stable")[:_NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest if np.isfinite(distance[j])}
    return [(names[i], names[j]) for i, j in sorted(pairs)]
