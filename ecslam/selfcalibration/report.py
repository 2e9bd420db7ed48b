"""What was found of a camera, as a table for people."""

from __future__ import annotations

from rich.table import Table

from .estimate import Found

ROWS = ("focal length (px)", "centre, across (px)", "centre, down (px)", "radial", "inverse depth (1/m)")
DIGITS = (2, 2, 2, 4, 4)


def table(found: Found) -> Table:
    """A line for each parameter: as it was given, and what the recording says of it."""
    out = Table(title=f"from {found.views} views")
    for name in ("", "given", "the recording says"):
        out.add_column(name, justify="left" if not name else "right")
    given, new = (
        (each.camera.fx, each.camera.cx, each.camera.cy, each.radial, each.inverse_depth)
        for each in (found.given, found.found)
    )
    spread = found.spread * (new[0], 1, 1, 1, 1)
    for row, (name, digits) in enumerate(zip(ROWS, DIGITS, strict=True)):
        says = "the same" if found.verdict.told[row] else "nothing certain"
        if found.verdict.wrong[row]:
            says = f"{_plain(new[row], digits)} ± {_plain(spread[row], digits)}"
        out.add_row(name, _plain(given[row], digits), says)
    return out


def _plain(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"
