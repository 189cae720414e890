"""The page, in viser: the controls that say what is wanted, and the drawing of what there is."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxbox.viewer import words
from jaxbox.viewer.scene import COLORINGS, Scene
from jaxbox.viewer.space import Caption
from jaxbox.viewer.thresholds import THRESHOLDS, Threshold
from jaxbox.viewer.viewer import Viewer, Wanted
from jaxbox.viz.colors import BACKGROUND, in_linear_light

GIVEN = "given"
"""Name of the settings of the command line in the list of presets."""
SETTINGS_NAME = "jaxbox.toml"
"""Name of the downloaded settings."""
PANEL_PX, CAMERA_PX, MARGIN_PX = 380, 640, 12
POINT_M, LINE_PX = 0.05, 2.5
_POINT_RANGE_M, _POINT_STEP_M = (0.01, 0.2), 0.01
_RATES = (1.0, 30.0)
_BRAND = (255, 190, 40)
_FINEST = 1e-6
_BOX_FONT, _LABEL_FONT = 0.8, 0.6
_PLAY, _PAUSE = "play", "pause"
_COPY, _DOWNLOAD, _RESET = "copy", "download", "reset"
_SWITCHES = (
    ("boxes", "boxes"),
    ("hulls", "hulls of their points"),
    ("captions", "class and score"),
    ("labels", "labelled boxes"),
    ("tracks", "tracks: ids, states, trails"),
)

_LOOKS: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "behind": ((-17.0, 0.0, 11.0), (7.0, 0.0, -2.0)),
    # Not straight down: the direction that is up on the screen would be any.
    "above": ((9.9, 0.0, 75.0), (10.0, 0.0, 0.0)),
    "driver": ((-2.0, 0.0, 1.5), (20.0, 0.0, -1.5)),
}
"""Places of the camera and what it looks at, m, sensor frame."""


class ViserPage:
    """The page on a viser server; the `Page` of a `Viewer`."""

    def __init__(self, server: Any, wanted: Wanted, *, num_sweeps: int) -> None:
        """Builds the page; `connect` makes its controls work.

        Args:
          server: a `viser.ViserServer`.
          wanted: what the controls are set to at first.
          num_sweeps: length of the timeline.
        """
        self._server, self._gui = server, server.gui
        self._scene: Scene | None = None
        self._captions: list[Any] = []
        self._nodes: dict[str, Any] = {}
        self._followed = wanted
        self._point_m = POINT_M
        self._prepare_space()
        self._answer = self._gui.add_html("")
        self._status = self._gui.add_html("")
        self._timeline, self._play, self._steps, self._rate = self._build_timeline(wanted, num_sweeps)
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Thresholds"):
            self._preset, self._actions = self._build_settings(wanted)
            self._sliders = self._build_thresholds(wanted)
        with tabs.add_tab("View"):
            self._build_view(wanted)
        with tabs.add_tab("Points"):
            self._points = self._gui.add_html("")
        self._camera_panel, self._camera = self._build_camera()

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

    def show_scene(self, scene: Scene | None) -> None:
        """Draws what differs from the scene before; points that stay are not sent again."""
        with self._server.atomic():
            self._draw_points(scene)
            self._draw_lines(scene)
            self._draw_captions(() if scene is None else scene.captions)
        self._draw_image(None if scene is None else scene.image)
        self._scene = scene

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
        if wanted.preset != before.preset or (before.changes and not wanted.changes):
            config = wanted.config
            for threshold in _all_thresholds():
                slider = self._sliders[threshold.name]
                slider.value = threshold.value(config)
                slider.disabled = not threshold.matters(config)

    def _prepare_space(self) -> None:
        # No button for sharing over the internet: see jaxbox.viewer.server.
        self._gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, brand_color=_BRAND
        )
        self._gui.main_panel.dock_right()
        self._gui.main_panel.set_width(PANEL_PX)
        pixel = np.array(BACKGROUND, np.uint8).reshape(1, 1, 3)
        self._server.scene.set_background_image(pixel, format="png")
        position, target = _LOOKS["behind"]
        self._server.initial_camera.position, self._server.initial_camera.look_at = position, target
        self._server.scene.add_frame("/sensor", axes_length=0.5, axes_radius=0.015)

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
                        hint=f"{threshold.name}: {threshold.hint}",
                    )
        return sliders

    def _build_view(self, wanted: Wanted) -> None:
        view, gui = wanted.view, self._gui
        looks = gui.add_button_group("look from", tuple(_LOOKS))
        looks.on_click(lambda event: _look(event.client, event.target.value))
        self._view_controls = {
            "coloring": gui.add_dropdown("colour by", tuple(COLORINGS), initial_value=view.coloring),
            "min_score": gui.add_slider(
                "shown score", 0.0, 1.0, 0.01, view.min_score, hint="Boxes that score less are hidden."
            ),
            **{field: gui.add_checkbox(text, getattr(view, field)) for field, text in _SWITCHES},
        }
        low, high = _POINT_RANGE_M
        size = gui.add_slider("point size (m)", low, high, _POINT_STEP_M, self._point_m)
        self._on_user(size, self._set_point_size)

    def _build_camera(self) -> tuple[Any, Any]:
        panel = self._gui.add_panel(visible=False)
        with panel.add_tab("Camera"):
            picture = self._gui.add_html("")
        panel.float(x=MARGIN_PX, y=-MARGIN_PX, width=CAMERA_PX)
        return panel, picture

    def _on_user(self, control: Any, act: Callable[[Any], None]) -> None:
        """Calls with a control's value where the user sets it, not where this page does."""

        def update(event: Any) -> None:
            if event.client_id is not None:
                act(control.value)

        control.on_update(update)

    def _set_point_size(self, size_m: float) -> None:
        self._point_m = float(size_m)
        if points := self._nodes.get("points"):
            points.point_size = self._point_m

    def _draw_points(self, scene: Scene | None) -> None:
        before = self._scene
        if scene is not None and before is not None and scene.points is before.points:
            if not np.array_equal(scene.colors, before.colors) and "points" in self._nodes:
                self._nodes["points"].colors = scene.colors
            return
        self._remove("points")
        if scene is not None and len(scene.points):
            self._nodes["points"] = self._server.scene.add_point_cloud(
                "/points",
                scene.points,
                scene.colors,
                point_size=self._point_m,
                point_shape="rounded",
                point_shading="flat",
                # Half floats are 6 cm apart at 80 m.
                precision="float32",
            )

    def _draw_lines(self, scene: Scene | None) -> None:
        lines = {} if scene is None else scene.lines
        for name in {*lines, *([] if self._scene is None else self._scene.lines)}:
            self._remove(name)
            if name in lines and len(lines[name].segments):
                self._nodes[name] = self._server.scene.add_line_segments(
                    f"/{name}",
                    lines[name].segments,
                    # Colours of the ends are not decoded there, as one colour of all lines is.
                    in_linear_light(lines[name].end_colors),
                    thickness=LINE_PX,
                    thickness_units="screen",
                )

    def _draw_captions(self, captions: tuple[Caption, ...]) -> None:
        for extra in self._captions[len(captions) :]:
            extra.remove()
        del self._captions[len(captions) :]
        for row, caption in enumerate(captions):
            props = {
                "text": caption.text,
                "position": caption.position,
                "anchor": "top-center" if caption.below else "bottom-center",
                "font_screen_scale": _LABEL_FONT if caption.below else _BOX_FONT,
            }
            if row == len(self._captions):
                self._captions.append(self._server.scene.add_label(f"/captions/{row}", **props))
            for name, value in props.items():
                setattr(self._captions[row], name, value)

    def _draw_image(self, image: np.ndarray | None) -> None:
        self._camera_panel.visible = image is not None
        before = None if self._scene is None else self._scene.image
        if image is not None and (before is None or not np.array_equal(image, before)):
            self._camera.content = words.picture(image)

    def _remove(self, name: str) -> None:
        if node := self._nodes.pop(name, None):
            node.remove()


def _all_thresholds() -> list[Threshold]:
    return [threshold for thresholds in THRESHOLDS.values() for threshold in thresholds]


def _preset_of(name: str) -> str | None:
    return None if name == GIVEN else name


def _threshold_setter(viewer: Viewer, name: str) -> Callable[[float], None]:
    return lambda value: viewer.want_threshold(name, float(value))


def _view_setter(viewer: Viewer, field: str) -> Callable[[Any], None]:
    return lambda value: viewer.want_view(**{field: value})


def _look(client: Any, name: str) -> None:
    position, target = _LOOKS[name]
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
