"""A page of ours in Chromium, without a network."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Page, sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL (Fig. 6) in software: a machine that tests has no graphics card
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


class Opened:
    """The page, its figures drawn, and what it complained about or asked the network for."""

    def __init__(self, page: Page, file: Path) -> None:
        self.page = page
        self.problems: list[str] = []
        self._requests: list[str] = []
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.problems.append(str(error)))
        page.on("request", lambda request: self._requests.append(request.url))
        page.goto(file.as_uri())
        page.wait_for_function(
            "[...document.querySelectorAll('.figure')].every(f => f.dataset.drawn === 'yes')",
            timeout=60_000,
        )

    def _heard(self, message: object) -> None:
        if getattr(message, "type", "") == "error":
            self.problems.append(str(getattr(message, "text", "")))

    @property
    def fetched(self) -> list[str]:
        """What did not come out of the page itself."""
        own = ("file:", "data:", "blob:")
        return [url for url in self._requests if not url.startswith(own)]


@contextmanager
def opening(file: Path, width: int = 1280) -> Iterator[Opened]:
    """The page while the browser runs; fails the test where there is no browser."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.fail(f"the page must be opened in a browser; install one of {', '.join(BROWSERS)}")
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found, args=list(FLAGS))
        context = chromium.new_context(offline=True, viewport={"width": width, "height": 900})
        yield Opened(context.new_page(), file)
        chromium.close()
