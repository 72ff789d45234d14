"""`p2gs-jax export`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.commands.export_display import DisplayFiles
from p2gs_jax.cli.options.export import DISPLAY, SIZE_MB, Export, Format, check_export
from p2gs_jax.core.atomic import atomic_folder, write_json
from p2gs_jax.core.progress import Reporter, TerminalReporter
from p2gs_jax.errors import UserError
from p2gs_jax.export.colmap_folder import write_colmap_folder
from p2gs_jax.export.nerfstudio_folder import write_nerfstudio_folder
from p2gs_jax.export.page import MEGABYTE, write_page
from p2gs_jax.export.sidecar import corrections_name, linear_sidecar
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.formats.through_gsply import require_gsply
from p2gs_jax.formats.usd import require_pxr
from p2gs_jax.gaussians.bake import display_of_splats
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.render.project import at_time
from p2gs_jax.run.photometry_files import write_appearance
from p2gs_jax.run.read import Run, load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.exif import read_exif_settings
from p2gs_jax.scene.images import ImageStore

PLACES: dict[Format, tuple[str, ...]] = {
    "linear-ply": ("linear.ply", "linear.json"),
    "display-ply": ("display.ply", "display.ply.json"),
    "splat": ("display.splat", "display.splat.json"),
    "spz": ("display.spz", "display.spz.json"),
    "compressed-ply": ("display.compressed.ply", "display.compressed.ply.json"),
    "gltf": ("display.glb", "display.glb.json"),
    "usd": ("display.usdc", "display.usdc.json"),
    "colmap": ("colmap",),
    "nerfstudio": ("nerfstudio",),
    "exr": ("exr",),
    "html": ("scene.html",),
}


def run(options: Export) -> int:
    """Write every requested format."""
    check_export(options)
    formats = tuple(dict.fromkeys(options.format))
    if {"spz", "compressed-ply"} & set(formats):
        require_gsply()
    if "usd" in formats:
        require_pxr()
    fitted = load_run(options.run, options.scene)
    if options.without_objects:
        fitted = fitted.without_objects()
    if fitted.cfg.render.background is not None and {"html", *DISPLAY} & set(formats):
        stdout().print(
            "The radiance behind the splats is in no format of splats: over black there."
        )
    transform = _display_transform(fitted, options)
    folder = options.out or options.run / "exports"
    places = [folder / place for name in formats for place in PLACES[name]]
    _check_places(folder, places, options.overwrite)
    _check_names(fitted, formats)
    if {"colmap", "nerfstudio"} & set(formats):
        fitted.require_photographs()
    store = fitted.store
    with TerminalReporter() as reporter:
        display = None
        if set(formats) & set(DISPLAY):
            splats = fitted.over_black()
            display = DisplayFiles(splats, store, transform, options.bake_steps, reporter)
        for name in formats:
            begin = time.monotonic()
            if name == "linear-ply":
                said = _linear_ply(folder, fitted, store)
            elif name == "colmap":
                said = _colmap(folder, fitted, store, reporter)
            elif name == "nerfstudio":
                said = _nerfstudio(folder, fitted, store, reporter)
            elif name == "exr":
                said = _exr(folder, fitted, store, reporter)
            elif name == "html":
                said = _html(folder, fitted.over_black(), transform, options, reporter)
            else:
                assert display is not None
                path, sidecar = (folder / place for place in PLACES[name])
                said = display.write(name, path, sidecar)
            seconds = time.monotonic() - begin
            stdout().print(f"{folder / PLACES[name][0]}: {said} ({seconds:.1f} s)", soft_wrap=True)
    return 0


def _display_transform(fitted: Run, options: Export) -> DisplayTransform:
    """Return the display transform of display colours.

    Raises:
        UserError: the run has no such curve, or no such white balance.
    """
    ev = options.exposure_ev or 0.0
    transform = fitted.common_display(ev)
    if options.exposure_of is not None:
        typical = fitted.metering.typical_log_exposure(options.exposure_of)
        transform = replace(transform, exposure=float(np.exp(typical)) * 2**ev)
    if options.white_balance_of is not None:
        balance = fitted.white_balance_of(options.white_balance_of)
        transform = replace(transform, white_balance=balance)
    if options.gamma is not None:
        transform = replace(transform, gamma=options.gamma)
    if options.curve is not None:
        try:
            transform = transform.with_curve(options.curve)
        except ValueError as error:
            raise UserError(
                f"--curve {options.curve}: {error}.",
                fix=f"leave it out for the run's own ({transform.formation.curve})",
            ) from error
    return display_of_splats(transform)


def _check_places(folder: Path, places: Sequence[Path], overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file.", fix="name a folder with --out")
    there = [path for path in places if path.exists()]
    if there and not overwrite:
        raise UserError(
            f"{there[0]} exists already.",
            fix="add --overwrite to replace it, or name another folder with --out",
        )


def _check_names(fitted: Run, formats: Sequence[Format]) -> None:
    """Refuse names that would lead files out of the folder they are written to."""
    if not set(formats) & {"colmap", "nerfstudio", "exr"}:
        return
    for view in fitted.scene.views:
        name = PurePosixPath(view.name)
        if name.is_absolute() or ".." in name.parts:
            raise UserError(
                f"the view {view.name} lies outside the image folder.",
                fix="move its photograph into the image folder and fit again",
            )


def _linear_ply(folder: Path, fitted: Run, store: ImageStore) -> str:
    g = at_time(fitted.as_of(), None)
    ply, sidecar = (folder / place for place in PLACES["linear-ply"])
    activation = fitted.cfg.render.radiance
    count = write_radiance(ply, g, np.ones(g.capacity, bool), activation=activation)
    content = linear_sidecar(g, fitted.cfg, fitted.scene, store, fitted.photometry)
    write_json(sidecar, content)
    kind = fitted.cfg.photometry.appearance
    if kind is not None:
        views = fitted.scene.training_views
        write_appearance(folder / corrections_name(kind), fitted.params.appearance, views)
    return f"{count} Gaussians of linear radiance; {sidecar.name} says how to read them"


def _colmap(folder: Path, fitted: Run, store: ImageStore, reporter: Reporter) -> str:
    place = folder / PLACES["colmap"][0]
    write_colmap_folder(
        place,
        fitted.scene,
        store,
        fitted.photometry["views"],
        on_view=lambda done, count: reporter.stage("Writing photographs", done, count),
    )
    scene = fitted.scene
    return f"{len(scene.views)} views, {len(scene.points)} points, exposures.csv"


def _nerfstudio(folder: Path, fitted: Run, store: ImageStore, reporter: Reporter) -> str:
    write_nerfstudio_folder(
        folder / PLACES["nerfstudio"][0],
        fitted.scene,
        store,
        fitted.photometry["views"],
        on_view=lambda done, count: reporter.stage("Writing photographs", done, count),
    )
    return f"{len(fitted.scene.views)} views for `ns-train splatfacto --data`"


def _exr(folder: Path, fitted: Run, store: ImageStore, reporter: Reporter) -> str:
    views = fitted.scene.views
    with atomic_folder(folder / PLACES["exr"][0]) as temporary:
        for index, view in enumerate(views):
            camera, transform = camera_of(store, index), fitted.own_display(index)
            result = fitted.render(camera)
            write_exr(
                (temporary / view.name).with_suffix(".exr"),
                np.asarray(result.linear),
                depth=np.asarray(result.depth),
                alpha=np.asarray(result.alpha),
                taken=transform,
                camera=camera,
                shot=read_exif_settings(view.image_path),
            )
            reporter.stage("Rendering", index + 1, len(views))
    return f"{len(views)} linear renders"


def _html(
    folder: Path, fitted: Run, look: DisplayTransform, options: Export, reporter: Reporter
) -> str:
    page = write_page(
        folder / PLACES["html"][0],
        fitted,
        look,
        size_mb=SIZE_MB if options.size_mb is None else options.size_mb,
        photographs=options.photographs or 0,
        say=reporter.stage,
    )
    return " ".join([f"{page.size / MEGABYTE:.1f} MB.", *page.sentences])
