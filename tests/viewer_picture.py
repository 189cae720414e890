"""Takes the documentation's pictures of the viewer, in a headless browser, of a synthetic sweep.

``python tests/viewer_picture.py docs`` needs the extra ``test`` and Chromium.
"""

import pathlib
import sys
import tempfile
import threading

from browser import chromium
from PIL import Image
from viewer_sweeps import write_kitti

from jaxbox import DetectorConfig, enable_cache, io, synthetic
from jaxbox.viewer import Comparison, View, Wanted, open_viewer

SEED = 0
NUM_SWEEPS = 4
SIZE_PX = (1400, 790)
NUM_COLORS = 128
"""Of the picture's palette: few enough for a small file, and none is missed."""
SETTLE_MS = 6000
"""For the last frame to be drawn without a graphics card."""


def main(folder: pathlib.Path) -> None:
    """Takes the pictures: a dark page, and a light one that compares two presets."""
    # As the command does: times of compiling would be those of the machine's other work.
    enable_cache()
    paper = Comparison(title="paper", config=DetectorConfig.paper())
    with tempfile.TemporaryDirectory() as sweeps:
        root = pathlib.Path(sweeps) / "training"
        sweep = synthetic.make_sweep(SEED, image=True)
        for index in range(NUM_SWEEPS):
            write_kitti(root, f"{index:06d}", sweep, pedestrian=False)
        _serve(root, folder / "viewer.png", tab="Boxes")
        _serve(root, folder / "viewer_compare.png", tab="View", light=True, comparison=paper)


def _serve(
    root: pathlib.Path,
    path: pathlib.Path,
    *,
    tab: str,
    light: bool = False,
    comparison: Comparison | None = None,
) -> None:
    wanted = Wanted(view=View(light=light))
    with open_viewer(io.open_sweeps(root), wanted=wanted, comparison=comparison) as (viewer, url):
        thread = threading.Thread(target=viewer.run)
        thread.start()
        try:
            _take(url, path, tab)
        finally:
            viewer.stop()
            thread.join()


def _take(url: str, path: pathlib.Path, tab: str) -> None:
    with chromium(size_px=SIZE_PX) as visit:
        visit.open(url)
        # Once more, for times without the compiler and the first reading of the files.
        visit.press("next")
        visit.wait(lambda: visit.text("name") == "000001")
        notice = visit.page.locator(".mantine-Notification-closeButton")
        while notice.count():
            notice.first.click()
            visit.page.wait_for_timeout(500)
        visit.tab(tab)
        visit.page.mouse.move(SIZE_PX[0] // 2, 20)
        visit.page.wait_for_timeout(SETTLE_MS)
        picture = Image.fromarray(visit.picture())
    picture.quantize(NUM_COLORS, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]))
