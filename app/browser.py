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


def dismiss_toasts(page: Any) -> None:
    """Close the notifications on a page."""
    page.evaluate("document.querySelectorAll('button.mantine-Notification-closeButton').forEach(b => b.click())")
    page.wait_for_timeout(400)
