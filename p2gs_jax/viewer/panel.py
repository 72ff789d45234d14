"""The controls beside the picture, and their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import get_args

import viser

from p2gs_jax.viewer.legend import note
from p2gs_jax.viewer.panel_interface import PanelActions, RunInfo
from p2gs_jax.viewer.picture_modes import Mode
from p2gs_jax.viewer.save import SAVED_WIDTHS
from p2gs_jax.viewer.settings import ChosenCurve, Settings

MODES: dict[str, Mode] = {
    "picture": "display",
    "stops (false colour)": "stops",
    "clipping": "clipping",
    "depth": "depth",
    "split: photo | render": "split",
}
MEAN = "mean of all"
NOWHERE = "choose ..."
FULL, SPLATS = "full (linear light)", "browser splats (fast)"
KEYS = "Drag to orbit, right-drag to pan, scroll to approach; W A S D Q E fly, arrows turn."


class Panel:
    """The controls of one browser."""

    def __init__(self, gui: viser.GuiApi, info: RunInfo, actions: PanelActions):
        """Add the controls to the page.

        Args:
            gui: of the client.
            info: of the run.
            actions: called by the controls.
        """
        self._gui, self._info, self._actions = gui, info, actions
        self._taken_as: int | None = info.start.taken_as
        self._status = gui.add_html(note("starting ..."))
        with gui.add_folder("Picture"):
            self._add_picture()
        with gui.add_folder("Camera"):
            self._add_camera()
        with gui.add_folder("Drive", expand_by_default=False):
            self._add_drive()
        with gui.add_folder("Save", expand_by_default=False):
            self._add_save()
        self.put(info.start)

    def _add_picture(self) -> None:
        gui, info, actions = self._gui, self._info, self._actions
        self._mode = gui.add_dropdown(
            "Show",
            list(MODES),
            hint="The split needs a camera that stands where a photograph was taken.",
        )
        self._legend = gui.add_html("", visible=False)
        self._split = gui.add_slider(
            "Split",
            0.0,
            1.0,
            0.01,
            0.5,
            visible=False,
            hint="Share of the photograph, from the left.",
        )
        reach = float(max(8, math.ceil(info.most_ev) + 2))
        self._exposure = gui.add_slider(
            "Exposure",
            -reach,
            reach,
            0.05,
            0.0,
            hint="Stops (EV) from the mean exposure of the training photographs.",
            marks=tuple(
                (float(ev), f"{ev:+d}" if ev else "0") for ev in (-round(reach), 0, round(reach))
            ),
        )
        self._metered = gui.add_checkbox(
            "Auto exposure",
            False,
            hint="The exposure follows what is seen, as the camera's did; the slider adds stops.",
        )
        low = min(1.0, math.floor(10 * min(info.gammas)) / 10)
        high = max(4.0, math.ceil(10 * max(info.gammas)) / 10)
        self._gamma = gui.add_slider(
            "Gamma",
            low,
            high,
            0.01,
            2.2,
            hint="2.2 is the curve itself; middle grey stays where it is.",
            marks=((low, f"{low:g}"), (2.2, "2.2"), (high, f"{high:g}")),
        )
        self._add_camera_effects()
        self._curves: dict[str, ChosenCurve] = {f"run's ({info.curve})": "run"}
        self._curves |= {c: c for c in get_args(ChosenCurve) if c not in ("run", info.curve)}
        self._curve = gui.add_dropdown(
            "Curve", list(self._curves), hint="The tone curve from exposed light to display values."
        )
        self._match = gui.add_dropdown(
            "Match photo",
            [MEAN, *info.names],
            hint="Sets all of this as a photograph was taken.",
        )
        self._renderer = gui.add_dropdown(
            "Renderer",
            [FULL, SPLATS],
            hint="Browser splats move at any speed, but mix display values instead of light.",
        )
        for handle in (self._exposure, self._gamma, self._curve, self._split):
            self._when_chosen(handle, lambda _: actions.display_changed())
        self._when_chosen(self._metered, actions.set_metered)
        for handle in (self._mode, self._renderer):
            self._when_chosen(handle, lambda _: actions.mode_changed())
        self._when_chosen(self._match, lambda name: actions.take_display_of(self._index(name)))

    def _add_camera_effects(self) -> None:
        """Add white balance and vignetting, where the run models them."""
        gui, info, changed = self._gui, self._info, self._actions.display_changed
        self._balance: tuple[viser.GuiInputHandle[float], ...] = ()
        if info.most_balance_ev is not None:
            most = float(max(2, math.ceil(info.most_balance_ev) + 1))
            self._balance = tuple(
                gui.add_slider(
                    name,
                    -most,
                    most,
                    0.01,
                    0.0,
                    hint="White balance: gain over green in stops (EV).",
                    marks=((-most, f"{-most:+g}"), (0.0, "0"), (most, f"{most:+g}")),
                )
                for name in ("Red / green", "Blue / green")
            )
        self._vignetting = gui.add_checkbox(
            "Vignetting",
            True,
            visible=info.vignetting,
            hint="Darkens towards the corners as the camera of the matched photo does.",
        )
        for handle in (*self._balance, self._vignetting):
            self._when_chosen(handle, lambda _: changed())

    def _add_camera(self) -> None:
        gui, info, actions = self._gui, self._info, self._actions
        gui.add_html(note(KEYS))
        self._go_to = gui.add_dropdown(
            "Go to",
            [NOWHERE, *info.names],
            hint="Stands where a photograph was taken, and matches its exposure and gamma.",
        )
        steps = gui.add_button_group("", ["previous", "next"])
        self._locked = gui.add_checkbox(
            "Lock exposure",
            False,
            hint="Go to, previous, next and split leave exposure, gamma and curve as they are.",
        )
        self._fov = gui.add_slider(
            "FOV", 5.0, 150.0, 0.5, 60.0, hint="Vertical field of view, degrees.", marks=()
        )
        self._cameras = gui.add_checkbox(
            "Cameras", False, hint="Where photographs were taken; click one to go there."
        )
        self._size = gui.add_slider(
            "Camera size", 0.2, 8.0, 0.1, 1.0, visible=False, hint="Times the usual.", marks=()
        )
        self._camera_legend = gui.add_html(info.camera_legend, visible=False)

        def choose(name: str) -> None:
            if (index := self._index(name)) is not None:
                actions.go_to(index)

        def step(name: str) -> None:
            now = self._index(self._go_to.value)
            by = 1 if name == "next" else -1
            count = len(info.names)
            actions.go_to((0 if by > 0 else count - 1) if now is None else (now + by) % count)

        def show(_: object) -> None:
            self._size.visible = self._camera_legend.visible = self._cameras.value
            actions.show_cameras(self._cameras.value, self._size.value)

        self._when_chosen(self._go_to, choose)
        steps.on_click(lambda event: step(event.target.value))
        self._when_chosen(self._fov, actions.set_fov)
        for handle in (self._cameras, self._size):
            self._when_chosen(handle, show)

    def _add_drive(self) -> None:
        gui, info, actions = self._gui, self._info, self._actions
        names = list(info.cameras)
        self._drive = gui.add_dropdown("Along", names, visible=len(names) > 1)
        last = max(info.cameras[names[0]] - 1, 1)
        self._place = gui.add_slider(
            "Frame", 0.0, float(last), 0.01, 0.0, marks=((0.0, "0"), (float(last), str(last)))
        )
        self._speed = gui.add_slider(
            "Speed", 0.2, 30.0, 0.1, 2.0, hint="Photographs per second.", marks=()
        )
        self._own = gui.add_checkbox(
            "Each photo's exposure",
            False,
            hint="Plays with the exposure of every photograph, instead of one for all.",
        )
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._playing = False

        def choose(name: str) -> None:
            end = max(info.cameras[name] - 1, 1)
            self._place.value = 0.0
            self._place.max = float(end)
            actions.set_place(name, 0.0)

        def toggle(_: object) -> None:
            self.set_playing(not self._playing)
            actions.play(self._playing)

        self._when_chosen(self._drive, choose)
        self._when_chosen(self._place, lambda at: actions.set_place(self._drive.value, at))
        self._play.on_click(toggle)

    def _add_save(self) -> None:
        gui, actions = self._gui, self._actions
        low, high = SAVED_WIDTHS
        width = gui.add_number(
            "Width",
            1920,
            min=low,
            max=high,
            step=1,
            hint=f"Pixels across, {low} to {high}; the height follows the window.",
        )
        png = gui.add_button("PNG, as shown", icon=viser.Icon.PHOTO_DOWN)
        exr = gui.add_button("EXR, linear light", icon=viser.Icon.FILE_DOWNLOAD)
        png.on_click(lambda _: actions.save("png", round(width.value)))
        exr.on_click(lambda _: actions.save("exr", round(width.value)))

    @staticmethod
    def _when_chosen(handle, act: Callable) -> None:
        """Call `act` when a person changes a control, but not when `put` does."""

        def on_update(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                act(event.target.value)

        handle.on_update(on_update)

    def _index(self, name: str) -> int | None:
        return self._info.names.index(name) if name in self._info.names else None

    def settings(self) -> Settings:
        """Return the present settings."""
        return Settings(
            gamma=self._gamma.value,
            exposure_ev=self._exposure.value,
            curve=self._curves[self._curve.value],
            taken_as=self._taken_as,
            balance_ev=self._balance_ev(),
            vignetting=self._vignetting.value,
            mode=MODES[self._mode.value],
            split=self._split.value,
            splats=self._renderer.value == SPLATS,
            metered=self._metered.value,
        )

    def _balance_ev(self) -> tuple[float, float] | None:
        if not self._balance:
            return None
        red, blue = self._balance
        return red.value, blue.value

    def put(self, settings: Settings) -> None:
        """Set the controls to a display transform; the mode stays."""
        self._taken_as = settings.taken_as
        self._metered.value = settings.metered
        self._exposure.value = settings.exposure_ev
        self._gamma.value = settings.gamma
        for handle, ev in zip(self._balance, settings.balance_ev or (), strict=False):
            handle.value = ev
        names = {value: name for name, value in self._curves.items()}
        self._curve.value = names.get(settings.curve, names["run"])
        index = settings.taken_as
        self._match.value = MEAN if index is None else self._info.names[index]

    def put_view(self, index: int, degrees: float) -> None:
        """Set the controls to the camera of a view."""
        self._go_to.value = self._info.names[index]
        self._fov.value = degrees

    def put_place(self, place: float) -> None:
        """Set the slider to a place on the drive."""
        self._place.value = min(place, self._place.max)

    @property
    def drive(self) -> tuple[str, float]:
        """Name of the camera whose drive is played, and the place on it."""
        return self._drive.value, self._place.value

    @property
    def speed(self) -> float:
        """Photographs per second."""
        return self._speed.value

    @property
    def locked(self) -> bool:
        """Whether moving to a view leaves the display transform as it is."""
        return self._locked.value

    @property
    def own_exposures(self) -> bool:
        """Whether to play with the exposure of every photograph."""
        return self._own.value

    def set_playing(self, playing: bool) -> None:
        """Set the button to `Pause` or `Play`."""
        self._playing = playing
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def set_status(self, html: str) -> None:
        """Show a status line."""
        if self._status.content != html:
            self._status.content = html

    def set_legend(self, html: str | None) -> None:
        """Show the legend of the picture's colours, or none."""
        self._split.visible = MODES[self._mode.value] == "split"
        if html is not None and self._legend.content != html:
            self._legend.content = html
        self._legend.visible = html is not None
