"""Opens a page of `offboard` in Chromium, a file without a network or a page that is served live,
and measures what a reader sees."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL (Fig. 6) is rendered in software, because a computer for tests may have no graphics card
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
DRAWN = """scheme => [...document.querySelectorAll(".figure")].every((figure) =>
  figure.dataset.drawn === scheme &&
  Math.abs(figure.querySelector(".svg-container").clientWidth - figure.clientWidth) <= 1)"""
# [contrast by WCAG 2.1, brightness of the background, text] of each text of page and figures
CONTRASTS = """() => {
  const linear = (v) => v <= 10.31475 ? v / 3294.6 : ((v / 255 + 0.055) / 1.055) ** 2.4;
  const rgb = (colour) => colour.match(/[0-9.]+/g).map(Number);
  const luminance = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const background = (element) => {
    const colour = rgb(getComputedStyle(element).backgroundColor);
    return colour.length < 4 || colour[3] > 0 ? colour : background(element.parentElement);
  };
  const texts = document.createTreeWalker(document.querySelector("main"), NodeFilter.SHOW_TEXT);
  const found = [];
  while (texts.nextNode()) {
    const element = texts.currentNode.parentElement;
    if (!texts.currentNode.textContent.trim() || element.closest("script, .modebar")) continue;
    const style = getComputedStyle(element);
    const ink = luminance(rgb(element.closest("svg") ? style.fill : style.color));
    const paper = luminance(background(element));
    const contrast = (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05);
    found.push([contrast, paper < 0.2 ? "dark" : "light", texts.currentNode.textContent]);
  }
  return found;
}"""
# [figure, width, height, [[text, left, top, right, bottom], ...]] in pixels of the figure
TEXT_BOXES = """() => [...document.querySelectorAll(".figure")].map((figure) => {
  const frame = figure.getBoundingClientRect();
  const boxes = [...figure.querySelectorAll("svg text, .modebar")]
    .filter((text) => text.textContent.trim() || text.matches(".modebar"))
    .filter((text) => text.getBoundingClientRect().width > 0) // others are not displayed
    .map((text) => [text.textContent.trim() || "tool bar", text.getBoundingClientRect()])
    .map(([text, box]) => [text, box.left - frame.left, box.top - frame.top,
                           box.right - frame.left, box.bottom - frame.top]);
  return [figure.id, frame.width, frame.height, boxes];
})"""
# Whether no text has moved since the previous poll: plotly lays a figure out in several passes
SETTLED = f"""() => {{
  const [before, now] = [window.textBoxes, JSON.stringify(({TEXT_BOXES})())];
  window.textBoxes = now;
  return before === now;
}}"""
TOUCHING_PX = 3  # boxes of neighbouring lines of text overlap by this much at most


class Opened:
    """A page with its figures drawn, the errors that it reported and its network requests."""

    def __init__(self, page: Page, place: Path | str) -> None:
        self.page = page
        self.problems: list[str] = []
        self._requests: list[str] = []
        page.on("console", self._on_console)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("request", lambda request: self._requests.append(request.url))
        self._place = place if isinstance(place, str) else place.as_uri()
        page.goto(self._place, timeout=60_000)
        self.switch("light")

    def _on_console(self, message: object) -> None:
        if getattr(message, "type", "") == "error":
            self.problems.append(str(getattr(message, "text", "")))

    @property
    def fetched(self) -> list[str]:
        """Requests for anything outside the page itself."""
        own = (self._place if self._place.startswith("http") else "file:", "data:", "blob:")
        return [url for url in self._requests if not url.startswith(own)]

    def switch(self, scheme: Any) -> None:
        """Change the colour scheme of the system, without a reload."""
        self._scheme = scheme
        self.page.emulate_media(color_scheme=scheme)
        self.page.wait_for_function(DRAWN, arg=scheme, timeout=60_000)

    def resize(self, width: int) -> None:
        """Change the width of the window, without a reload."""
        self.page.set_viewport_size({"width": width, "height": 900})
        self.page.wait_for_function(DRAWN, arg=self._scheme, timeout=60_000)
        self.page.wait_for_function(SETTLED, polling=300, timeout=60_000)

    def unreadable(self) -> list[str]:
        """Return texts on a background of the other colour scheme, or with a contrast below 4.5,
        the minimum of WCAG 2.1 (level AA)."""
        found = self.page.evaluate(CONTRASTS)
        assert found
        return [
            f"{text}: contrast {contrast:.1f} on a {background} background"
            for contrast, background, text in found
            if contrast < 4.5 or background != self._scheme
        ]

    def width_px(self) -> int:
        """The width of the whole page, which exceeds that of the window if something overflows."""
        return int(self.page.evaluate("document.documentElement.scrollWidth"))

    def colliding(self) -> list[str]:
        """Return texts of figures that are cut off, or that overlap each other or the tool bar."""
        found = []
        for figure, width, height, boxes in self.page.evaluate(TEXT_BOXES):
            for i, (text, left, top, right, bottom) in enumerate(boxes):
                if left < -1 or top < -1 or right > width + 1 or bottom > height + 1:
                    found.append(f"{figure}: {text} is cut off")
                for other, left_, top_, right_, bottom_ in boxes[:i]:
                    wide = min(right, right_) - max(left, left_)
                    if wide > 1 and min(bottom, bottom_) - max(top, top_) > TOUCHING_PX:
                        found.append(f"{figure}: {text} overlaps {other}")
        return found


@contextmanager
def opening(place: Path | str, width: int = 1280) -> Iterator[Opened]:
    """Yield the opened page; the test fails if no browser is installed."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.fail(f"the page must be opened in a browser; install one of {', '.join(BROWSERS)}")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        offline = isinstance(place, Path)
        context = chromium.new_context(offline=offline, viewport={"width": width, "height": 900})
        yield Opened(context.new_page(), place)
        chromium.close()
