"""The viewer in a real browser: ``pytest -m browser``, with Chromium installed."""

import threading

import cv2
import numpy as np
import pytest
from browser import LOOPBACK, WAIT_S, chromium
from test_detector import street
from viewer_sweeps import write_three_streets

from jaxbox import DetectorConfig, PointCloud, detect, io
from jaxbox.config.fields import config_from_toml
from jaxbox.viewer import View, Wanted, open_viewer
from jaxbox.viz import BoxSet
from jaxbox.viz.colors import ESTIMATE

pytestmark = pytest.mark.browser

SHOWN = 0.05
"""These streets are sparse, and their boxes score low."""
VIEW_PX = (370, 590)
"""Rows and columns of the 3D view that no panel covers: their headings are yellow too."""


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A viewer on three streets, the second of which cannot be read, and the address of its page."""
    root = write_three_streets(tmp_path_factory.mktemp("streets") / "training")
    with open_viewer(io.open_sweeps(root), wanted=Wanted(view=View(min_score=SHOWN))) as (viewer, url):
        thread = threading.Thread(target=viewer.run)
        thread.start()
        yield viewer, url
        viewer.stop()
        thread.join(WAIT_S)


@pytest.fixture(scope="module")
def browser():
    with chromium() as visit:
        yield visit


@pytest.fixture
def visit(browser, served):
    """The page at the first street with the default settings, without a complaint before and after."""
    viewer, url = served
    viewer.want(index=0, preset="default", changes={}, playing=False, view=View(min_score=SHOWN))
    browser.open(url)
    browser.wait(lambda: "000000" in browser.text("name"))
    yield browser
    assert browser.complaints == []
    assert browser.addresses
    assert browser.hosts() <= set(LOOPBACK), "the page works without a network"


def num_boxes(seed, *, min_score=SHOWN, config=None):
    detections = detect(PointCloud.from_numpy(street(seed).xyz, street(seed).intensity), config)
    return len(BoxSet.from_detections(detections, min_score=min_score))


def hue_saturation_value(picture):
    """(..., 3) int of an RGB picture: hue as half its degrees."""
    return cv2.cvtColor(np.asarray(picture, np.uint8), cv2.COLOR_RGB2HSV).astype(int)


def brightness(visit):
    """Mean of the 3D view, 0 to 255."""
    return float(visit.picture()[: VIEW_PX[0], : VIEW_PX[1]].mean())


def box_pixels(visit):
    """Pixels of the 3D view in the hue of the boxes: where no graphics card draws, thin lines are blended."""
    hue, saturation, value = np.moveaxis(
        hue_saturation_value(visit.picture()[: VIEW_PX[0], : VIEW_PX[1]]), 2, 0
    )
    boxes = hue_saturation_value([[ESTIMATE]])[0, 0, 0]
    return int(np.sum((np.abs(hue - boxes) <= 5) & (saturation > 110) & (value > 180)))


def test_the_page_shows_the_boxes(visit):
    assert visit.number("vehicles") == num_boxes(0) > 3
    assert visit.number("milliseconds") > 0
    assert "nothing was dropped" in visit.text("status")
    # Viser's panel has a button that asks for a tunnel through its authors' server.
    assert visit.page.get_by_text("share", exact=False).count() == 0
    visit.tab("View")
    # Browns and blues: nothing but the boxes is yellow.
    visit.choose("colour by", "ground")
    # Which of two lines in one place is drawn last is anybody's guess.
    visit.page.get_by_label("labelled boxes", exact=True).uncheck()
    visit.wait(lambda: box_pixels(visit) > 500)
    visit.page.get_by_label("boxes", exact=True).uncheck()
    visit.wait(lambda: box_pixels(visit) < 100)


def test_a_slider_detects_anew_and_compiles_nothing(visit):
    compiles, many = visit.number("compiles"), visit.number("vehicles")
    assert compiles >= 1
    visit.drag("fewest points", 0.5)
    visit.wait(lambda: visit.number("vehicles") < many)
    few = visit.number("vehicles")
    visit.drag("fewest points", 0.0)
    visit.wait(lambda: visit.number("vehicles") > few)
    visit.type_value("greatest overlap", 1.0)
    visit.wait(lambda: visit.number("vehicles") > many)
    visit.press("reset")
    visit.wait(lambda: visit.number("vehicles") == many)
    assert visit.number("compiles") == compiles


def test_the_shown_score_hides_boxes(visit):
    visit.tab("View")
    visit.type_value("shown score", 0.25)
    visit.wait(lambda: visit.number("vehicles") == num_boxes(0, min_score=0.25))
    assert num_boxes(0, min_score=0.25) < num_boxes(0)


@pytest.mark.slow
def test_a_preset_compiles_once_and_sets_the_sliders(visit):
    compiles = visit.number("compiles")
    tolerance = visit.control("plane tolerance").locator("xpath=following-sibling::*//input")
    assert tolerance.input_value() == "0.1"
    visit.choose("preset", "paper")
    visit.wait(lambda: visit.number("vehicles") == num_boxes(0, config=DetectorConfig.paper()))
    visit.wait(lambda: tolerance.input_value() == "0.2")
    assert visit.number("compiles") <= compiles + 1
    compiles = visit.number("compiles")
    visit.choose("preset", "default")
    visit.wait(lambda: visit.number("vehicles") == num_boxes(0))
    assert visit.number("compiles") == compiles, "both are compiled by now"


def test_the_settings_are_copied_and_downloaded(visit, served, tmp_path):
    viewer, _ = served
    visit.type_value("fewest points", 12.0)
    visit.type_value("link growth", 0.01)
    wanted = {"clustering.min_points": 12.0, "clustering.adaptive_growth": 0.01}
    visit.wait(lambda: viewer.wanted.changes == wanted)
    visit.press("copy")
    shown = visit.page.locator("[data-jaxbox=settings]")
    text = shown.input_value()
    assert config_from_toml(text) == viewer.wanted.config != DetectorConfig()
    visit.page.locator("[data-jaxbox=settings] + button").click()
    visit.page.get_by_text("copied", exact=True).wait_for()
    assert visit.page.evaluate("navigator.clipboard.readText()") == text
    visit.press("close")
    shown.wait_for(state="detached")
    with visit.page.expect_download() as download:
        visit.press("download")
    download.value.save_as(tmp_path / "settings.toml")
    assert io.read_config(tmp_path / "settings.toml") == viewer.wanted.config
    assert download.value.suggested_filename == "jaxbox.toml"


@pytest.mark.slow
def test_the_timeline_passes_over_a_sweep_that_cannot_be_read(visit):
    visit.type_value("sweep", 2)
    visit.wait(lambda: "000001.bin" in visit.text("error"))
    visit.wait(lambda: box_pixels(visit) < 100)
    visit.press("next")
    visit.wait(lambda: visit.text("name") == "000002")
    assert visit.number("vehicles") == num_boxes(2)
    visit.press("play")
    visit.wait(lambda: visit.text("name") == "000000")
    visit.wait(lambda: visit.text("name") == "000002")
    visit.press("pause")
    visit.page.get_by_role("button", name="play", exact=True).wait_for()


def test_a_click_on_a_row_flies_to_its_box(visit):
    visit.tab("Boxes")
    rows = visit.page.locator("[data-box]")
    visit.wait(lambda: rows.count() == visit.number("vehicles"))
    before = visit.picture()[: VIEW_PX[0], : VIEW_PX[1]].astype(int)
    visit.page.locator("[data-box='2']").click()
    # The hidden buttons of the same numbers fly; the legend stays where it is.
    visit.wait(lambda: np.abs(visit.picture()[: VIEW_PX[0], : VIEW_PX[1]] - before).mean() > 5)
    assert "box" in visit.text("legend")


def test_the_page_turns_light_and_dark_again(visit):
    assert brightness(visit) < 100
    visit.tab("View")
    light = visit.page.get_by_label("light page", exact=True)
    light.check()
    visit.wait(lambda: brightness(visit) > 180)
    light.uncheck()
    visit.wait(lambda: brightness(visit) < 100)


def test_a_threshold_explains_itself_under_the_mouse(visit):
    visit.control("obstacles up to").hover()
    visit.page.get_by_text("Setting: ground.max_height_m").wait_for()
