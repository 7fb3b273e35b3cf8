"""A browser without a screen that looks at a live page: for measurements, tests and pictures of it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ..errors import InputError, MissingExtraError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DESKTOP, PHONE = (1400, 860), (390, 844)
"""width and height [CSS pixels]"""
_OPTIONS = [
    "--no-sandbox",  # there is none in many containers, and it sees nothing but palpate's own page
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
# counts pictures in which at least so many things were drawn, and when the first of them was there
_COUNTER = """(() => {
  const seen = {drawn: 0, first: null, pictures: 0};
  window.palpate = seen;
  for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"]) {
    const real = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      seen.drawn += 1;
      return real.apply(this, given);
    };
  }
  const next = () => {
    if (seen.drawn >= THINGS) {
      seen.pictures += 1;
      seen.first ??= performance.now();
    }
    seen.drawn = 0;
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})();"""


def find_browser() -> str | None:
    """A Chromium on this machine; None: there is none."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


@contextmanager
def browser() -> Iterator[Browser]:
    """Chromium without a screen; pictures are drawn by the processor.

    Raises:
        MissingExtraError: playwright is not installed.
        InputError: there is no Chromium.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise MissingExtraError("bench", "driving a browser") from None
    path = find_browser()
    if path is None:
        raise InputError(f"no browser: install one of {', '.join(BROWSERS)}")
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=path, args=_OPTIONS)
        try:
            yield found
        finally:
            found.close()


def opened(browser: Browser, url: str, size: tuple[int, int], things: int, patience_s: float = 120.0) -> Page:
    """A page in a window of `size`, with `things` drawn in it.

    Args:
        browser: the browser.
        url: of the page.
        size: (width, height) [CSS pixels].
        things: shapes that make a picture.
        patience_s: how long it may take [s].
    """
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(1e3 * patience_s)
    page.add_init_script(_COUNTER.replace("THINGS", str(things)))
    page.goto(url)
    page.wait_for_function("window.palpate && window.palpate.first !== null")
    return page


def first_picture(page: Page) -> float:
    """From opening the page until the arm was in it [s]."""
    return 1e-3 * float(page.evaluate("window.palpate.first"))


def pictures(page: Page) -> int:
    """Pictures drawn so far."""
    return int(page.evaluate("window.palpate.pictures"))


def dismiss(page: Page) -> None:
    """Close the messages that lie over the picture, such as viser's about a processor that draws."""
    # by the page's own hand: one that closes by itself meanwhile is not waited for
    close = "all => all.forEach(button => button.click())"
    buttons = page.locator(".mantine-Notification-closeButton")
    while buttons.count():
        buttons.evaluate_all(close)
        page.wait_for_timeout(300.0)
