"""The page, in viser: the controls that say what is wanted, and the drawing of what there is."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxbox.viewer import words
from jaxbox.viewer.box_table import BoxRow, box_rows, describe_boxes
from jaxbox.viewer.canvas import POINT_M, Canvas
from jaxbox.viewer.legend import describe_legend
from jaxbox.viewer.scene import COLORINGS, Scene
from jaxbox.viewer.thresholds import THRESHOLDS, Threshold
from jaxbox.viewer.viewer import Viewer, Wanted
from jaxbox.viz.colors import BACKGROUND, Color

GIVEN = "given"
"""Name of the settings of the command line in the list of presets."""
SETTINGS_NAME = "jaxbox.toml"
"""Name of the downloaded settings."""
PANEL_PX, CAMERA_PX, LEGEND_PX, MARGIN_PX = 400, 640, 220, 12
LIGHT_BACKGROUND: Color = (244, 246, 249)
"""Behind the points of a light page."""
FLIGHT_S = 0.5
"""The camera takes so long to a box: one sees where it goes."""
_FLIGHT_STEPS = 20
_MAX_APART_M, _APART_STEP_M = 160.0, 5.0
_POINT_RANGE_M, _POINT_STEP_M = (0.01, 0.2), 0.01
_RATES = (1.0, 30.0)
_BRAND, _LIGHT_BRAND = (255, 190, 40), (110, 66, 0)
_PLAY, _PAUSE = "play", "pause"
_COPY, _DOWNLOAD, _RESET = "copy", "download", "reset"
_SWITCHES = (
    ("boxes", "boxes"),
    ("hulls", "hulls of their points"),
    ("captions", "class and score"),
    ("labels", "labelled boxes"),
    ("tracks", "tracks: ids, states, trails"),
    ("light", "light page"),
)

Point = tuple[float, float, float]
_WHOLE_M = 55.0
"""A camera sees two scenes so far apart from twice as far."""
_LOOKS: Mapping[str, tuple[Point, Point]] = {
    "behind": ((-17.0, 0.0, 11.0), (7.0, 0.0, -2.0)),
    # Not straight down: the direction that is up on the screen would be any.
    "above": ((9.9, 0.0, 75.0), (10.0, 0.0, 0.0)),
    "driver": ((-2.0, 0.0, 1.5), (20.0, 0.0, -1.5)),
}
"""Places of the camera and what it looks at, m, sensor frame."""


class ViserPage:
    """The page on a viser server; the `Page` of a `Viewer`."""

    def __init__(self, server: Any, wanted: Wanted, *, num_sweeps: int, compares: bool = False) -> None:
        """Builds the page; `connect` makes its controls work.

        Args:
          server: a `viser.ViserServer`.
          wanted: what the controls are set to at first.
          num_sweeps: length of the timeline.
          compares: whether two scenes are to be shown.
        """
        self._server, self._gui = server, server.gui
        self._canvas, self._compared = Canvas(server.scene, "/sensor"), Canvas(server.scene, "/compared")
        self._rows: list[BoxRow] = []
        self._followed = wanted
        self._light: bool | None = None
        self._prepare_space(wanted)
        self._answer = self._gui.add_html("")
        self._status = self._gui.add_html("")
        self._timeline, self._play, self._steps, self._rate = self._build_timeline(wanted, num_sweeps)
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Thresholds"):
            self._preset, self._actions = self._build_settings(wanted)
            self._sliders = self._build_thresholds(wanted)
        with tabs.add_tab("View"):
            self._build_view(wanted, compares=compares)
        with tabs.add_tab("Boxes"):
            self._boxes = self._gui.add_html("")
            with self._gui.add_folder("fly to", expand_by_default=False) as self._flights_folder:
                self._flights = self._gui.add_button_group("box", ("1",))
        with tabs.add_tab("Points"):
            self._points = self._gui.add_html("")
        self._camera_panel, self._camera = self._build_panel("Camera", y=-MARGIN_PX, width=CAMERA_PX)
        self._legend_panel, self._legend = self._build_panel("Legend", y=MARGIN_PX, width=LEGEND_PX)

    def connect(self, viewer: Viewer) -> None:
        """Makes every control ask a viewer for what it says.

        Args:
          viewer: whose page this is.
        """
        self._on_user(self._timeline, lambda value: viewer.want(index=int(value) - 1))
        self._on_user(self._rate, lambda value: viewer.want(sweeps_per_s=float(value)))
        self._play.on_click(lambda _: viewer.want(playing=not viewer.wanted.playing))
        self._steps.on_click(lambda event: viewer.step(1 if event.target.value == "next" else -1))
        self._on_user(self._preset, lambda value: viewer.want(preset=_preset_of(value), changes={}))
        for name, slider in self._sliders.items():
            self._on_user(slider, _threshold_setter(viewer, name))
        for field, control in self._view_controls.items():
            self._on_user(control, _view_setter(viewer, field))
        self._actions.on_click(lambda event: _act(event.target.value, event.client, viewer))
        self._flights.on_click(lambda event: self._fly(event.client, int(event.target.value)))

    def show_scene(self, scene: Scene | None, compared: Scene | None = None) -> None:
        """Draws what differs from the scenes before; points that stay are not sent again."""
        apart_m = 0.0 if scene is None else scene.view.apart_m
        scenes = [shown for shown in (scene, compared) if shown is not None]
        before = self._canvas.scene
        with self._server.atomic():
            self._canvas.draw(scene)
            self._compared.draw(compared, apart_m=apart_m)
            self._list_boxes(box_rows(scenes, apart_m=apart_m))
            self._legend_panel.visible = scene is not None
            self._legend.content = "" if scene is None else describe_legend(scene, compared)
        self._draw_image(None if scene is None else scene.image, None if before is None else before.image)

    def show_words(self, answer: str, *, status: str = "", points: str = "") -> None:
        """Shows texts, HTML."""
        with self._server.atomic():
            self._answer.content, self._status.content, self._points.content = answer, status, points

    def follow(self, wanted: Wanted) -> None:
        """Sets the controls that move without the user."""
        before, self._followed = self._followed, wanted
        if self._timeline.value != wanted.index + 1:
            self._timeline.value = wanted.index + 1
        self._play.label = _PAUSE if wanted.playing else _PLAY
        self._paint(light=wanted.view.light)
        if wanted.preset != before.preset or (before.changes and not wanted.changes):
            config = wanted.config
            for threshold in _all_thresholds():
                slider = self._sliders[threshold.name]
                slider.value = threshold.value(config)
                slider.disabled = not threshold.matters(config)

    def _prepare_space(self, wanted: Wanted) -> None:
        self._paint(light=wanted.view.light)
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(PANEL_PX)
        position, target = _place(_LOOKS["behind"], wanted.view.apart_m)
        self._server.initial_camera.position, self._server.initial_camera.look_at = position, target

    def _paint(self, *, light: bool) -> None:
        """Makes the page light or dark, where it is not."""
        if light == self._light:
            return
        self._light = light
        # No button for sharing over the internet: see jaxbox.viewer.server.
        self._gui.configure_theme(
            dark_mode=not light,
            show_logo=False,
            show_share_button=False,
            brand_color=_LIGHT_BRAND if light else _BRAND,
        )
        pixel = np.array(LIGHT_BACKGROUND if light else BACKGROUND, np.uint8).reshape(1, 1, 3)
        self._server.scene.set_background_image(pixel, format="png")

    def _build_timeline(self, wanted: Wanted, num_sweeps: int) -> tuple[Any, Any, Any, Any]:
        many = num_sweeps > 1
        timeline = self._gui.add_slider("sweep", 1, num_sweeps, 1, wanted.index + 1, visible=many)
        steps = self._gui.add_button_group("step", ("previous", "next"), visible=many)
        play = self._gui.add_button(_PLAY, visible=many, hint="One sweep after the other, round the end.")
        low, high = _RATES
        rate = self._gui.add_slider(
            "sweeps a second", low, high, 1.0, wanted.sweeps_per_s, visible=many, hint="At most."
        )
        return timeline, play, steps, rate

    def _build_settings(self, wanted: Wanted) -> tuple[Any, Any]:
        presets = [*([] if wanted.given is None else [GIVEN]), *type(wanted.config).presets()]
        preset = self._gui.add_dropdown(
            "preset",
            presets,
            initial_value=GIVEN if wanted.preset is None else wanted.preset,
            hint="Another one compiles once; the thresholds are set to its own.",
        )
        actions = self._gui.add_button_group(
            "settings",
            (_COPY, _DOWNLOAD, _RESET),
            hint=f"copy: as the TOML that `jaxbox detect --config` reads; download: as {SETTINGS_NAME}; "
            "reset: the thresholds of the preset.",
        )
        return preset, actions

    def _build_thresholds(self, wanted: Wanted) -> dict[str, Any]:
        config, sliders = wanted.config, {}
        for stage, thresholds in THRESHOLDS.items():
            with self._gui.add_folder(stage):
                for threshold in thresholds:
                    value = threshold.value(config)
                    sliders[threshold.name] = self._gui.add_slider(
                        threshold.label,
                        # A file of settings may go beyond the usual range.
                        min(threshold.low, value),
                        max(threshold.high, value),
                        threshold.step,
                        value,
                        disabled=not threshold.matters(config),
                        hint=threshold.tooltip,
                    )
        return sliders

    def _build_view(self, wanted: Wanted, *, compares: bool) -> None:
        view, gui = wanted.view, self._gui
        looks = gui.add_button_group("look from", tuple(_LOOKS))
        looks.on_click(lambda event: self._look_from(event.client, event.target.value))
        self._view_controls = {
            "coloring": gui.add_dropdown("colour by", tuple(COLORINGS), initial_value=view.coloring),
            "min_score": gui.add_slider(
                "shown score", 0.0, 1.0, 0.01, view.min_score, hint="Boxes that score less are hidden."
            ),
            "apart_m": gui.add_slider(
                "apart (m)",
                0.0,
                _MAX_APART_M,
                _APART_STEP_M,
                view.apart_m,
                visible=compares,
                hint="How far to the right what is compared is drawn; 0 draws it in the same place.",
            ),
            **{field: gui.add_checkbox(text, getattr(view, field)) for field, text in _SWITCHES},
        }
        low, high = _POINT_RANGE_M
        size = gui.add_slider("point size (m)", low, high, _POINT_STEP_M, POINT_M)
        self._on_user(size, self._set_point_size)

    def _build_panel(self, title: str, *, y: int, width: int) -> tuple[Any, Any]:
        """A window over the 3D view, hidden at first, and the text in it."""
        panel = self._gui.add_panel(visible=False)
        with panel.add_tab(title):
            text = self._gui.add_html("")
        panel.float(x=MARGIN_PX, y=y, width=width)
        return panel, text

    def _on_user(self, control: Any, act: Callable[[Any], None]) -> None:
        """Calls with a control's value where the user sets it, not where this page does."""

        def update(event: Any) -> None:
            if event.client_id is not None:
                act(control.value)

        control.on_update(update)

    def _set_point_size(self, size_m: float) -> None:
        for canvas in (self._canvas, self._compared):
            canvas.set_point_size(float(size_m))

    def _list_boxes(self, rows: list[BoxRow]) -> None:
        self._rows = rows
        self._boxes.content = describe_boxes(rows)
        self._flights_folder.visible = bool(rows)
        numbers = tuple(str(number + 1) for number in range(len(rows)))
        if rows and self._flights.options != numbers:
            self._flights.options = numbers

    def _look_from(self, client: Any, name: str) -> None:
        _look(client, *_place(_LOOKS[name], self._followed.view.apart_m))

    def _fly(self, client: Any, number: int) -> None:
        """Takes one reader's camera to a box; the table may have changed under the click."""
        if client is None or number > len(self._rows):
            return
        starts = np.array([client.camera.position, client.camera.look_at])
        ends = np.array(self._rows[number - 1].look())
        for step in range(1, _FLIGHT_STEPS + 1):
            # Slow at both ends.
            share = (1 - np.cos(np.pi * step / _FLIGHT_STEPS)) / 2
            _look(client, *((1 - share) * starts + share * ends))
            time.sleep(FLIGHT_S / _FLIGHT_STEPS)

    def _draw_image(self, image: np.ndarray | None, before: np.ndarray | None) -> None:
        self._camera_panel.visible = image is not None
        if image is not None and (before is None or not np.array_equal(image, before)):
            self._camera.content = words.picture(image)


def _all_thresholds() -> list[Threshold]:
    return [threshold for thresholds in THRESHOLDS.values() for threshold in thresholds]


def _preset_of(name: str) -> str | None:
    return None if name == GIVEN else name


def _threshold_setter(viewer: Viewer, name: str) -> Callable[[float], None]:
    return lambda value: viewer.want_threshold(name, float(value))


def _view_setter(viewer: Viewer, field: str) -> Callable[[Any], None]:
    return lambda value: viewer.want_view(**{field: value})


def _place(look: tuple[Point, Point], apart_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A look at two scenes: from so much farther back that both are seen."""
    position, target = (np.array(point) for point in look)
    aside = np.array((0.0, -apart_m / 2, 0.0))
    return target + (position - target) * (1 + apart_m / _WHOLE_M) + aside, target + aside


def _look(client: Any, position: Any, target: Any) -> None:
    with client.atomic():
        client.camera.up_direction = (0.0, 0.0, 1.0)
        client.camera.position, client.camera.look_at = position, target


def _act(action: str, client: Any, viewer: Viewer) -> None:
    if action == _COPY:
        _show_settings(client, viewer.wanted.config_text)
    elif action == _DOWNLOAD:
        client.send_file_download(SETTINGS_NAME, viewer.wanted.config_text.encode(), save_immediately=True)
    else:
        viewer.want(changes={})


def _show_settings(client: Any, text: str) -> None:
    """A window with the text, for one reader: who clicked."""
    with client.gui.add_modal("Settings for jaxbox detect --config") as window:
        client.gui.add_html(words.copy_box(text))
        client.gui.add_button("close").on_click(lambda _: window.close())
