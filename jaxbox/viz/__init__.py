"""Pictures of sweeps and boxes with OpenCV, and plots with matplotlib (the ``plots`` extra).

Pictures are (height, width, 3) uint8 arrays, red green blue. Points and boxes are in the sensor
frame: x forward, y left, z up, metres.
"""

from jaxbox.viz.bird_eye import BirdEyeFrame, draw_bird_eye
from jaxbox.viz.boxes import BoxSet
from jaxbox.viz.canvas import save_png
from jaxbox.viz.colors import color_by_height, color_by_id
from jaxbox.viz.image_boxes import draw_image_boxes
from jaxbox.viz.lidar_view import LidarCamera, draw_lidar_view
from jaxbox.viz.plots import plot_dimensions, plot_residuals, save_figure
from jaxbox.viz.stages import draw_stages

__all__ = [
    "BirdEyeFrame",
    "BoxSet",
    "LidarCamera",
    "color_by_height",
    "color_by_id",
    "draw_bird_eye",
    "draw_image_boxes",
    "draw_lidar_view",
    "draw_stages",
    "plot_dimensions",
    "plot_residuals",
    "save_figure",
    "save_png",
]
