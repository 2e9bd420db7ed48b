"""The README's pictures, made from real runs: ``python -m ecslam_app.shots RUN [OTHER_RUN] --out assets``."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ecslam.messages import RunTo
from ecslam.types import InputError

from .browser import dismiss_toasts, launch, new_page
from .runs import load_run
from .server import Dashboard, view

DESKTOP, PHONE = (1440, 860), (390, 780)
SETTLE_MS, MOST_LOOKS = 1500, 30
STILL = 0.02  # mean change of grey values
FILM_STEPS, FILM_SIZE, STEP_MS, END_MS = 36, (960, 573), 160, 2500


def take(runs: list[Path], out: Path) -> list[Path]:
    """Write the pictures dark, phone, loops and (with two runs) compare, and the film of the first run, into ``out``.
    Raises InputError."""
    out.mkdir(parents=True, exist_ok=True)
    made = []
    with launch() as browser:
        for name, size, dark, some, act in _pictures(runs):
            dashboard = view(some, port=0, dark=dark)
            try:
                made.append(_take_one(browser, dashboard, size, act, out / f"dashboard_{name}.png"))
            finally:
                dashboard.close()
        made.append(_film(browser, runs[0], out / "dashboard.webp"))
    return made


def _pictures(
    runs: list[Path],
) -> list[tuple[str, tuple[int, int], bool, list[Path], Callable[[Any], None]]]:
    first = runs[:1]
    pictures = [
        ("dark", DESKTOP, True, first, _show_plots),
        ("phone", PHONE, False, first, _show_nothing),
        ("loops", DESKTOP, False, first, _show_loop),
    ]
    return pictures + ([("compare", DESKTOP, True, runs, _show_nothing)] if len(runs) == 2 else [])


def _take_one(
    browser: Any, dashboard: Dashboard, size: tuple[int, int], act: Callable[[Any], None], path: Path
) -> Path:
    page = _opened(browser, dashboard, size)
    act(page)
    dismiss_toasts(page)
    path.write_bytes(lighter(_still(page)))
    page.close()
    return path


def _film(browser: Any, run: Path, path: Path) -> Path:
    """A run from its first frame to its last as an animated picture."""
    dashboard = view([run], port=0)
    try:
        page, steps = _opened(browser, dashboard, DESKTOP), []
        _show_plots(page)
        for frame in np.linspace(0, load_run(run).last, FILM_STEPS).round().astype(int):
            dashboard.engine.submit(RunTo(int(frame)))
            dismiss_toasts(page)
            steps.append(_picture(_still(page)).resize(FILM_SIZE, Image.Resampling.LANCZOS))
        page.close()
    finally:
        dashboard.close()
    shown = [STEP_MS] * (len(steps) - 1) + [END_MS]
    steps[0].save(path, save_all=True, append_images=steps[1:], duration=shown, loop=0, quality=80, method=6)
    return path


def _opened(browser: Any, dashboard: Dashboard, size: tuple[int, int]) -> Any:
    """The dashboard's page, with its mesh."""
    page = new_page(browser, *size)
    page.goto(dashboard.url)
    page.locator(".ec-row b").wait_for()
    while dashboard.hub.scene.mesh is None:
        page.wait_for_timeout(100)
    page.wait_for_timeout(SETTLE_MS)
    return page


def _still(page: Any) -> bytes:
    """A screenshot once the page has come to rest, however slow the machine."""
    before = np.zeros(0)
    for _ in range(MOST_LOOKS):
        page.wait_for_timeout(SETTLE_MS)
        png = page.screenshot()
        now = np.asarray(Image.open(io.BytesIO(png)).convert("L"), float)
        if before.shape == now.shape and np.abs(now - before).mean() < STILL:
            break
        before = now
    return bytes(png)


def _picture(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png)).convert("RGB")


def lighter(png: bytes) -> bytes:
    """A screenshot as a smaller PNG, without the lowest bit of its colours, which nobody sees."""
    out = io.BytesIO()
    Image.fromarray(np.asarray(_picture(png)) | 1).save(out, "png", optimize=True)
    return out.getvalue()


def _show_nothing(page: Any) -> None:
    """The page as it opens."""


def _show_plots(page: Any) -> None:
    page.get_by_role("tab", name="Plots").click()


def _show_loop(page: Any) -> None:
    page.get_by_role("tab", name="Loops").click()
    page.get_by_role("button", name="Next event").click()


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="one run folder, or two to compare")
    parser.add_argument("--out", type=Path, default=Path("assets"), help="where the pictures go")
    arguments = parser.parse_args()
    try:
        for path in take(arguments.runs, arguments.out):
            print(path)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
