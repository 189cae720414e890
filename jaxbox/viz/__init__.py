"""Pictures of sweeps and boxes with OpenCV, and plots with matplotlib (the ``plots`` extra).

Pictures are (height, width, 3) uint8 arrays, red green blue. Points and boxes are in the sensor
frame: x forward, y left, z up, metres.
"""

from jaxbox.viz.answer import draw_detections
from jaxbox.viz.bird_eye import BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxGroup, BoxSet
from jaxbox.viz.canvas import save_png
from jaxbox.viz.colors import color_by_height, color_by_id
from jaxbox.viz.contact_sheet import make_contact_sheet
from jaxbox.viz.image_boxes import draw_image_boxes
from jaxbox.viz.judged import JudgedFrame, draw_judged_frame, group_by_verdict
from jaxbox.viz.lidar_view import LidarCamera, draw_lidar_view
from jaxbox.viz.plots import plot_dimensions, plot_residuals, save_figure
from jaxbox.viz.stages import draw_stages
from jaxbox.viz.tracks import draw_drive, draw_image_tracks, draw_tracks
from jaxbox.viz.video import open_gif, open_video

__all__ = [
    "BirdEyeFrame",
    "BoxGroup",
    "BoxSet",
    "JudgedFrame",
    "LidarCamera",
    "color_by_height",
    "color_by_id",
    "draw_bird_eye",
    "draw_detections",
    "draw_drive",
    "draw_image_boxes",
    "draw_image_tracks",
    "draw_judged_frame",
    "draw_lidar_view",
    "draw_stages",
    "draw_tracks",
    "group_by_verdict",
    "make_contact_sheet",
    "open_gif",
    "open_video",
    "plot_dimensions",
    "plot_residuals",
    "save_figure",
    "save_png",
]
