"""The controls beside the picture, and their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import viser

from p2gs_jax.core.numerics import LN2, evenly_spaced
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.photometry.formation import darkens
from p2gs_jax.viewer.pictures import SAVED_WIDTHS, Mode, exposure_legend, note
from p2gs_jax.viewer.settings import ChosenCurve, Settings, common_settings, exposures_ev
from p2gs_jax.viewer.viewed_run import ViewedRun

if TYPE_CHECKING:
    from p2gs_jax.viewer.session import BrowserSession

MODES: dict[str, Mode] = {
    "picture": "display",
    "stops (false colour)": "stops",
    "depth": "depth",
    "split: photo | render": "split",
}
MEAN = "mean of all"
NOWHERE = "choose ..."
KEYS = "Drag to orbit, right-drag to pan, scroll to approach; W A S D Q E fly, arrows turn."
HINTS = {
    "Show": "The split needs the camera position of a photograph.",
    "Exposure": "Stops (EV) from the mean exposure of the training photographs.",
    "Vignetting": "Darkens the corners as in the matched photograph.",
    "Curve": "The tone curve maps radiance times exposure to display values.",
    "Match photo": "Sets these controls to the values of a photograph.",
    "Go to": "Moves to the camera of a photograph, and sets its exposure and gamma.",
    "Lock exposure": "Go to, previous, next and split do not change exposure, gamma and curve.",
    "Cameras": "Shows the cameras of the photographs; click one to go there.",
    "Width": "Width from {} to {} pixels; the height follows the window.".format(*SAVED_WIDTHS),
}

# Charts of an unfinished fit by title, with the styles of their curves.
CHARTS: dict[str, dict[str, Any]] = {
    "Loss": {"width": 1.5},
    "Exposures of the training views, EV": {"width": 0, "points": {"show": True, "size": 5}},
}
MOST_RECORDS = 300  # records of the log in a chart
LINE, INK, GRID = "#4dabf7", "#c1c2c5", "#373a40"  # colours of charts


class Panel:
    """The controls of one browser.

    `locked` is the control that keeps the display settings when the camera moves to a view.
    """

    def __init__(self, gui: viser.GuiApi, viewed: ViewedRun, actions: BrowserSession):
        """Add the controls to the page of a client; they call `actions`."""
        self._gui, self._viewed, self._actions = gui, viewed, actions
        self._names = [view.name for view in viewed.run.scene.views]
        self._status = gui.add_html(note("starting ..."))
        self._training = gui.add_folder("Training", visible=False)
        with self._training:  # a sentence and charts
            self._progress = gui.add_html("")
            self._charts = [self._chart(*words) for words in CHARTS.items()]
        with gui.add_folder("Picture"):
            self._add_picture()
        with gui.add_folder("Camera"):
            self._add_camera()
        with gui.add_folder("Save", expand_by_default=False):
            self._add_save()
        self.put(common_settings(viewed.run))

    def _slider(
        self, name: str, low: float, high: float, step: float, start: float, **more: Any
    ) -> viser.GuiInputHandle[float]:
        more = {"marks": (), "hint": HINTS.get(name), **more}
        return self._gui.add_slider(name, low, high, step, start, **more)

    def _dropdown(self, name: str, options: list[str]) -> viser.GuiDropdownHandle:
        return self._gui.add_dropdown(name, options, hint=HINTS.get(name))

    def _checkbox(self, name: str, start: bool, **more: Any) -> viser.GuiInputHandle[bool]:
        return self._gui.add_checkbox(name, start, hint=HINTS.get(name), **more)

    def _add_picture(self) -> None:
        run, actions = self._viewed.run, self._actions
        evs = exposures_ev(run).values()
        gammas = [float(g) for g in np.asarray(run.params.photometry.gammas)]
        curve = run.cfg.photometry.curve
        self._mode = self._dropdown("Show", list(MODES))
        self._legend = self._gui.add_html("", visible=False)
        self._split = self._slider("Split", 0.0, 1.0, 0.01, 0.5, visible=False)
        reach = float(max(8, math.ceil(max(map(abs, evs))) + 2))
        marks = ((-reach, f"{-reach:+g}"), (0.0, "0"), (reach, f"{reach:+g}"))
        self._exposure = self._slider("Exposure", -reach, reach, 0.05, 0.0, marks=marks)
        low = min(1.0, math.floor(10 * min(gammas)) / 10)
        high = max(4.0, math.ceil(10 * max(gammas)) / 10)
        marks = ((low, f"{low:g}"), (2.2, "2.2"), (high, f"{high:g}"))
        self._gamma = self._slider("Gamma", low, high, 0.01, 2.2, marks=marks)
        self._balance: tuple[viser.GuiInputHandle[float], ...] = ()
        if (balance := run.params.photometry.white_balance) is not None:
            largest = float(np.abs(np.asarray(balance)).max()) / LN2
            most = float(math.ceil(2 * largest) + 1)
            self._balance = tuple(
                self._slider(name, -most, most, 0.01, 0.0)
                for name in ("Red / green", "Blue / green")
            )
        self._vignetting = self._checkbox("Vignetting", True, visible=darkens(run.cfg.photometry))
        self._curves: dict[str, ChosenCurve] = {f"run's ({curve})": "run"}
        self._curves |= {c: c for c in get_args(ChosenCurve) if c not in ("run", curve)}
        self._curve = self._dropdown("Curve", list(self._curves))
        self._match = self._dropdown("Match photo", [MEAN, *self._names])
        look = (self._exposure, self._gamma, self._curve, self._split, self._vignetting)
        for handle in (*look, *self._balance):
            self._when_chosen(handle, lambda _: actions.display_changed())
        self._when_chosen(self._mode, lambda _: actions.mode_changed())
        self._when_chosen(self._match, lambda name: actions.take_display_of(self._index(name)))

    def _add_camera(self) -> None:
        gui, actions, evs = self._gui, self._actions, exposures_ev(self._viewed.run).values()
        gui.add_html(note(KEYS))
        self._go_to = self._dropdown("Go to", [NOWHERE, *self._names])
        steps = gui.add_button_group("", ["previous", "next"])
        self.locked = self._checkbox("Lock exposure", False)
        self._fov = self._slider("FOV", 5.0, 150.0, 0.5, 60.0)
        cameras = self._checkbox("Cameras", False)
        legend = gui.add_html(exposure_legend(min(evs), max(evs)), visible=False)

        def choose(name: str) -> None:
            if (index := self._index(name)) is not None:
                actions.go_to(index)

        def step(name: str) -> None:
            now, by = self._index(self._go_to.value), 1 if name == "next" else -1
            count = len(self._names)
            actions.go_to((0 if by > 0 else count - 1) if now is None else (now + by) % count)

        def show(_: object) -> None:
            legend.visible = cameras.value
            actions.show_cameras(cameras.value)

        self._when_chosen(self._go_to, choose)
        steps.on_click(lambda event: step(event.target.value))
        self._when_chosen(self._fov, actions.set_fov)
        self._when_chosen(cameras, show)

    def _add_save(self) -> None:
        low, high = SAVED_WIDTHS
        width = self._gui.add_number("Width", 1920, min=low, max=high, step=1, hint=HINTS["Width"])
        png = self._gui.add_button("PNG, as shown", icon=viser.Icon.PHOTO_DOWN)
        exr = self._gui.add_button("EXR, linear light", icon=viser.Icon.FILE_DOWNLOAD)
        png.on_click(lambda _: self._actions.save("png", round(width.value)))
        exr.on_click(lambda _: self._actions.save("exr", round(width.value)))

    @staticmethod
    def _when_chosen(handle: Any, act: Callable[[Any], object]) -> None:
        """Call `act` when the user changes a control, but not when `put` changes it."""

        def on_update(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                act(event.target.value)

        handle.on_update(on_update)

    def _index(self, name: str) -> int | None:
        return self._names.index(name) if name in self._names else None

    def settings(self) -> Settings:
        """Return the current settings."""
        balance = tuple(handle.value for handle in self._balance)
        return Settings(
            gamma=self._gamma.value,
            exposure_ev=self._exposure.value,
            curve=self._curves[self._curve.value],
            view=self._view,
            balance_ev=(balance[0], balance[1]) if balance else None,
            vignetting=self._vignetting.value,
            mode=MODES[self._mode.value],
            split=self._split.value,
        )

    def put(self, settings: Settings) -> None:
        """Set the controls to a display transform; the mode does not change."""
        index = self._view = settings.view
        self._exposure.value = settings.exposure_ev
        self._gamma.value = settings.gamma
        for handle, ev in zip(self._balance, settings.balance_ev or (), strict=False):
            handle.value = ev
        names = {value: name for name, value in self._curves.items()}
        self._curve.value = names.get(settings.curve, names["run"])
        self._match.value = MEAN if index is None else self._names[index]

    def put_view(self, index: int, degrees: float) -> None:
        """Set the controls to a view and its vertical field of view."""
        self._go_to.value = self._names[index]
        self._fov.value = degrees

    def show_training(self, log: list[dict[str, Any]]) -> None:
        """Show the last record of the log of a fit, its losses, and the exposures."""
        self._training.visible = True
        self._progress.content = note(LogRecord(**log[-1]).summary())
        rows = evenly_spaced(len(log), MOST_RECORDS)
        losses = [(log[row]["step"], log[row]["loss"]) for row in rows]
        evs = list(exposures_ev(self._viewed.run).items())
        for chart, pairs in zip(self._charts, (losses, evs), strict=True):
            chart.data = tuple(np.array(pairs, float).T)

    def _chart(self, title: str, style: dict[str, Any]) -> viser.GuiUplotHandle:
        axes, nothing = ({"stroke": INK, "grid": {"stroke": GRID}},) * 2, (np.zeros(1),) * 2
        plain: Any = {"scales": {"x": {"time": False}}, "legend": {"show": False}, "axes": axes}
        series: Any = ({}, {"stroke": LINE, **style})
        return self._gui.add_uplot(nothing, series, title=title, aspect=2.2, **plain)

    def set_status(self, html: str) -> None:
        """Show a status line."""
        if self._status.content != html:
            self._status.content = html

    def set_legend(self, html: str | None) -> None:
        """Show the legend of the picture; None hides it."""
        self._split.visible = MODES[self._mode.value] == "split"
        if html is not None and self._legend.content != html:
            self._legend.content = html
        self._legend.visible = html is not None
