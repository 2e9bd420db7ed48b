"""What was found of a camera, for people."""

from __future__ import annotations

from rich.table import Table

from .cells import parameters
from .estimate import Found

ROWS = ("focal length (px)", "centre, across (px)", "centre, down (px)", "radial", "inverse depth (1/m)")
DIGITS = (2, 2, 2, 4, 4)


def table(found: Found) -> Table:
    """A line for each parameter: as it was given, and what the recording says of it."""
    out = Table(title=f"from {found.views} views")
    for name in ("", "given", "the recording says"):
        out.add_column(name, justify="left" if not name else "right")
    given, new = parameters(found.given), parameters(found.found)
    spread = found.spread * (new[0], 1, 1, 1, 1)
    for row, (name, digits) in enumerate(zip(ROWS, DIGITS, strict=True)):
        says = "the same" if found.verdict.told[row] else "nothing certain"
        if found.verdict.wrong[row]:
            says = f"{_plain(new[row], digits)} ± {_plain(spread[row], digits)}"
        out.add_row(name, _plain(given[row], digits), says)
    return out


def sentences(found: Found) -> list[str]:
    """What it comes to, and what to do about what is not told."""
    before, after = (f"{1e3 * apart:.2f} mm" for apart in found.apart_m)
    if found.verdict.wrong.any():
        out = [f"Surfaces that several views see lie {after} apart instead of {before}."]
    else:
        out = [f"Surfaces that several views see lie {before} apart. Nothing to write."]
    if not found.verdict.told.all():
        out.append("What is not certain takes a recording in which the camera turns further, in a furnished room.")
    return out


def _plain(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"
