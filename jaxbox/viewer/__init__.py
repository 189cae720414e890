"""An interactive page of sweeps and boxes in the browser (the ``view`` extra).

`Frames` reads sweeps, `Session` detects in them, `TrackMemory` follows the vehicles of a drive,
`build_scene` makes arrays of what is to be drawn, and `Viewer` keeps a page in step with what its user asks
for; `open_viewer` puts them together behind an address. Only `page` and `server` know viser.
"""

from jaxbox.viewer.config_text import config_text
from jaxbox.viewer.drives import TrackedFrame, TrackMemory
from jaxbox.viewer.frames import Frame, Frames
from jaxbox.viewer.scene import COLORINGS, Scene, View, build_scene
from jaxbox.viewer.serving import Comparison, open_viewer
from jaxbox.viewer.session import Session, Shown
from jaxbox.viewer.thresholds import THRESHOLDS, Threshold
from jaxbox.viewer.viewer import Viewer, Wanted

__all__ = [
    "COLORINGS",
    "THRESHOLDS",
    "Comparison",
    "Frame",
    "Frames",
    "Scene",
    "Session",
    "Shown",
    "Threshold",
    "TrackMemory",
    "TrackedFrame",
    "View",
    "Viewer",
    "Wanted",
    "build_scene",
    "config_text",
    "open_viewer",
]
