"""The drawing of scenes, in viser: what has not changed since the scene before is not sent again."""

from typing import Any

import numpy as np

from jaxbox.viewer.scene import Scene
from jaxbox.viewer.space import Caption
from jaxbox.viz.colors import in_linear_light

POINT_M, LINE_PX = 0.05, 2.5
_BOX_FONT, _LABEL_FONT = 0.8, 0.6


class Canvas:
    """One scene at a place of its own in viser's."""

    def __init__(self, space: Any, name: str) -> None:
        """Begins empty.

        Args:
          space: a `viser.SceneApi`.
          name: of the frame that everything hangs from, such as ``/sensor``.
        """
        self._space, self._name = space, name
        self._frame = space.add_frame(name, axes_length=0.5, axes_radius=0.015, visible=False)
        self._captions: list[Any] = []
        self.nodes: dict[str, Any] = {}
        """Points and lines that are drawn, by name."""
        self.scene: Scene | None = None
        """What is drawn."""
        self._point_m = POINT_M

    def draw(self, scene: Scene | None, *, apart_m: float = 0.0) -> None:
        """Draws a scene in the place of the one before.

        Args:
          scene: what to draw; None for nothing.
          apart_m: how far to the right of the origin, m.
        """
        self._frame.visible = scene is not None
        self._frame.position = (0.0, -apart_m, 0.0)
        self._draw_points(scene)
        self._draw_lines(scene)
        self._draw_captions(() if scene is None else scene.captions)
        self.scene = scene

    def set_point_size(self, size_m: float) -> None:
        """Draws the points in another size, m."""
        self._point_m = size_m
        if points := self.nodes.get("points"):
            points.point_size = size_m

    def _draw_points(self, scene: Scene | None) -> None:
        before = self.scene
        if scene is not None and before is not None and scene.points is before.points:
            if not np.array_equal(scene.colors, before.colors) and "points" in self.nodes:
                self.nodes["points"].colors = scene.colors
            return
        self._remove("points")
        if scene is not None and len(scene.points):
            self.nodes["points"] = self._space.add_point_cloud(
                f"{self._name}/points",
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
        for name in {*lines, *([] if self.scene is None else self.scene.lines)}:
            self._remove(name)
            if name in lines and len(lines[name].segments):
                self.nodes[name] = self._space.add_line_segments(
                    f"{self._name}/{name}",
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
                self._captions.append(self._space.add_label(f"{self._name}/captions/{row}", **props))
            for name, value in props.items():
                setattr(self._captions[row], name, value)

    def _remove(self, name: str) -> None:
        if node := self.nodes.pop(name, None):
            node.remove()
