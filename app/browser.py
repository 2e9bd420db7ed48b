"""A headless Chromium that can draw WebGL without a GPU or a screen, for screenshots and tests."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from typing import Any

from ecslam.types import InputError

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--disable-default-apps",
    "--disable-dev-shm-usage",
    "--mute-audio",
]
# Without a GPU every picture is drawn by the processor that the server needs too: eight a second are enough.
_FEWER_PICTURES = (
    "const draw=requestAnimationFrame;requestAnimationFrame=f=>setTimeout(()=>draw(f),120);"
    "cancelAnimationFrame=clearTimeout"
)
PATIENCE_MS = 120_000


def find_chromium() -> str | None:
    """The path of an installed Chromium, or None."""
    return next((path for path in map(shutil.which, _NAMES) if path), None)


def install_chromium() -> str | None:
    """An installed Chromium, else one installed with apt where this process may; None when neither works."""
    found = find_chromium()
    if found is None and hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("apt-get"):
        for command in (["apt-get", "update"], ["apt-get", "install", "-y", "chromium"]):
            with contextlib.suppress(OSError, subprocess.SubprocessError):
                subprocess.run(command, capture_output=True, timeout=240, check=False)
        found = find_chromium()
    return found


@contextlib.contextmanager
def launch(path: str | None = None) -> Iterator[Any]:
    """A Playwright browser. Raises InputError when Playwright or Chromium is missing."""
    path = path or find_chromium()
    if path is None:
        raise InputError("no Chromium found; install it, e.g. with: apt-get install chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise InputError("Playwright is missing; install it with: pip install playwright") from None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, headless=True, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


def new_page(browser: Any, width: int, height: int, sharpness: float = 1.0) -> Any:
    """A blank tab of width x height CSS pixels, each ``sharpness`` wide in pictures. It draws seldom and waits long."""
    page = browser.new_page(viewport={"width": width, "height": height}, device_scale_factor=sharpness)
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(_FEWER_PICTURES)
    return page


def dismiss_toasts(page: Any) -> None:
    """Close the notifications on a page."""
    page.evaluate("document.querySelectorAll('button.mantine-Notification-closeButton').forEach(b => b.click())")
    page.wait_for_timeout(400)
