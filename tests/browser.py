"""A headless Chromium at the viewer's page, for the tests and the README's picture."""

import contextlib
import os
import pathlib
import tempfile
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
from playwright.sync_api import Locator, Page, sync_playwright

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # The 3D view, where there is no graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
SIZE_PX = (1000, 640)
WAIT_S = 180
"""Longer than compiling takes; only a test that fails waits for so long."""
LOOPBACK = ("127.0.0.1", "localhost")
_POLL_S = 0.1


class Visit:
    """A page that is open, what it asked for, and what it complained of."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.addresses: list[str] = []
        self.complaints: list[str] = []
        page.set_default_timeout(WAIT_S * 1e3)
        page.on("request", lambda request: self.addresses.append(request.url))
        page.on("websocket", lambda socket: self.addresses.append(socket.url))
        page.on("console", lambda message: self._hear(message.type, message.text))
        page.on("pageerror", lambda error: self._hear("error", str(error)))

    def _hear(self, kind: str, text: str) -> None:
        if kind == "error":
            self.complaints.append(text)

    def hosts(self) -> set[str | None]:
        """Of all addresses asked for; what the page makes itself (blob:, data:) has none."""
        return {urlsplit(address.removeprefix("blob:")).hostname for address in self.addresses} - {None}

    def open(self, url: str) -> None:
        """Goes to the page and waits for its first answer."""
        self.page.goto(url)
        self.wait(lambda: self.number("vehicles") is not None)

    def text(self, name: str) -> str:
        """What one part of the page says; empty where it is not there."""
        found = self.page.locator(f"[data-jaxbox={name}]")
        return found.first.inner_text() if found.count() else ""

    def number(self, name: str) -> float | None:
        """A number of the page; None where it is not there."""
        text = self.text(name)
        return float(text) if text else None

    def wait(self, condition) -> None:
        """Until something holds. The page changes by messages, so it is asked again and again."""
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, f"still not: the page says {self.text('answer')!r}"
            self.page.wait_for_timeout(_POLL_S * 1e3)

    def control(self, label: str) -> Locator:
        """Slider, list or box with a label."""
        marked = self.page.locator("label").filter(has=self.page.get_by_text(label, exact=True))
        name = (marked if marked.count() else self.page.get_by_text(label, exact=True)).first
        return self.page.locator(f"[id='{name.get_attribute('for')}']")

    def type_value(self, label: str, value: float) -> None:
        """Types a number into the field next to a slider."""
        self.control(label).locator("xpath=following-sibling::*//input").fill(f"{value:g}")

    def drag(self, label: str, share: float) -> None:
        """Drags a slider's thumb to a share of its length."""
        # The mouse goes by places on the screen.
        self.control(label).scroll_into_view_if_needed()
        thumb, track = self.control(label).get_by_role("slider"), self.control(label).bounding_box()
        start = thumb.bounding_box()
        assert track is not None
        assert start is not None
        y = start["y"] + start["height"] / 2
        self.page.mouse.move(start["x"] + start["width"] / 2, y)
        self.page.mouse.down()
        self.page.mouse.move(track["x"] + share * track["width"], y, steps=8)
        self.page.mouse.up()

    def choose(self, label: str, option: str) -> None:
        """Picks an entry of a list."""
        self.control(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def tab(self, name: str) -> None:
        """Opens a tab of the panel."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def press(self, name: str) -> None:
        """Presses a button."""
        self.page.get_by_role("button", name=name, exact=True).first.click()

    def picture(self, path: pathlib.Path | None = None) -> np.ndarray:
        """(h, w, 3) uint8, RGB: what is on the screen."""
        encoded = np.frombuffer(self.page.screenshot(path=path), np.uint8)
        return cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@contextlib.contextmanager
def chromium(*, size_px: tuple[int, int] = SIZE_PX):
    """Starts the browser with an empty profile; yields a visit to an empty page."""
    width, height = size_px
    with tempfile.TemporaryDirectory() as profile, sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=CHROMIUM,
            headless=True,
            args=list(FLAGS),
            viewport={"width": width, "height": height},
            permissions=["clipboard-read", "clipboard-write"],
        )
        try:
            yield Visit(context.new_page())
        finally:
            context.close()
