"""Error, losses, residual and times over the frames."""

from __future__ import annotations

import time
from typing import cast

import numpy as np
from numpy.typing import NDArray
from viser import uplot

from ecslam.messages import Snapshot, State

from .. import theme
from ..hub import Hub
from ..panel import BasePanel

EVERY_S = 0.5
HEIGHT, NEAR_PX = 158, 10
X_AXIS_PX, Y_AXIS_PX = 36, 46
_WHOLE = tuple(k * 10**n for n in range(7) for k in (1, 2, 5))
_RESIDUAL = "_mm"  # ends the names of what is measured in millimetres and therefore no loss
_PALETTE = (theme.ESTIMATE, theme.TRUTH, theme.WINDOW, theme.LOOP, (234, 179, 8), theme.BEFORE, theme.KEYFRAME)
# Its class keeps it out of the legend and without a point under the mouse; a line has no points at its two ends.
_UPRIGHT = cast(
    uplot.Series,
    {
        "label": "shown",
        "class": "ec-upright",
        "stroke": theme.css(theme.KEYFRAME),
        "width": 1.2,
        "points": uplot.Series_Points(show=False),
    },
)


class Chart:
    """One uPlot chart whose series can grow in number; below it, the values under the mouse.

    Over a replay an upright line marks the frame that is shown.
    """

    def __init__(self, hub: Hub, title: str, markers: bool = False, peaks: bool = True) -> None:
        """markers: the last series is points only. peaks: rare high values stay within the range.

        A chart is out of sight while it has nothing to show.
        """
        self._gui, self._names, self._markers, self._peaks = hub.server.gui, [""], markers, peaks
        self._upright = (_UPRIGHT,) if hub.replay is not None else ()
        self._plot = self._gui.add_uplot(
            (np.array([0.0, 1.0]), np.array([np.nan, np.nan])),
            (uplot.Series(label="frame"), uplot.Series(label=title)),
            title=title,
            height=HEIGHT,
            axes=_axes(),
            cursor=uplot.Cursor(
                drag=uplot.Cursor_Drag(x=False, y=False), hover=uplot.Cursor_Hover(prox=NEAR_PX, skip=(np.nan,))
            ),
            padding=(6, 14, 0, 0),
            visible=False,
        )

    @property
    def visible(self) -> bool:
        """Whether it shows anything."""
        return bool(self._plot.visible)

    def entitle(self, title: str) -> None:
        """Name the chart anew."""
        if self._plot.title != title:
            self._plot.title = title

    def show(self, names: list[str], columns: tuple[NDArray[np.float64], ...], frame: int) -> None:
        """Draw columns (frame numbers first) under ``names``, with an explicit range. frame: the one that is shown."""
        names = [n for n, column in zip(names, columns[1:], strict=True) if np.isfinite(column).any()]
        columns = (columns[0], *(c for c in columns[1:] if np.isfinite(c).any()))
        self._plot.visible = bool(names) and len(columns[0]) > 1
        if not self._plot.visible:
            return
        if names != self._names:
            self._names = names
            lines = [_line(name, k) for k, name in enumerate(names)]
            if self._markers and len(names) > 1:
                lines[-1] = _dots(names[-1])
            self._plot.series = (uplot.Series(label="frame"), *lines, *self._upright)
        high = max(float(np.nanmax(c) if self._peaks else np.nanpercentile(c, 97)) for c in columns[1:])
        top = high * 1.08 + 1e-6
        if self._upright:
            columns = with_upright(columns, frame, top)
        self._plot.scales = {
            "x": uplot.Scale(time=False, range=(float(columns[0][0]), float(columns[0][-1]))),
            "y": uplot.Scale(range=(0.0, top)),
        }
        self._plot.data = columns


class Panel(BasePanel):
    """The charts, refreshed twice a second at most."""

    tab, order = "Plots", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        self._none = hub.server.gui.add_html(
            theme.card('<span class="dim">Nothing to plot before the second frame.</span>')
        )
        self._error = Chart(hub, "Error so far (ATE, cm)")
        self._losses = Chart(hub, "Weighted losses")
        self._residual = Chart(hub, "Alignment residual (mm)")
        self._times = Chart(hub, "Time per frame (ms)", peaks=False)
        self._shown = 0.0

    def snapshot(self, s: Snapshot) -> None:
        now = time.monotonic()
        moving = s.state in (State.TRACKING, State.MAPPING, State.INITIALISING)
        if moving and now - self._shown < EVERY_S:
            return
        self._shown = now
        history, names = self.hub.history, self.hub.history.names()
        losses = [name for name in names if not name.endswith(_RESIDUAL)]
        residual = [name for name in names if name.endswith(_RESIDUAL)]
        with self.hub.server.atomic():
            self._error.show(["ATE"], history.series(["ate_cm"]), s.frame)
            self._losses.show(list(map(_label, losses)), history.series(losses), s.frame)
            self._residual.show(list(map(_label, residual)), history.series(residual), s.frame)
            self._times.show(["tracking", "mapping"], history.series(["track_ms", "map_ms"]), s.frame)
            self._none.visible = not self._times.visible


def with_upright(columns: tuple[NDArray[np.float64], ...], frame: int, top: float) -> tuple[NDArray[np.float64], ...]:
    """Columns (frame numbers first) and one more, which is an upright line up to ``top`` at the row nearest ``frame``.

    That row comes twice, for the two ends of the line.
    """
    at = int(np.argmin(np.abs(columns[0] - frame)))
    twice = tuple(np.insert(column, at, column[at]) for column in columns)
    upright = np.full(len(twice[0]), np.nan)
    upright[at : at + 2] = 0.0, top
    return (*twice, upright)


def _label(name: str) -> str:
    return name.removeprefix("loss ").removesuffix(_RESIDUAL).replace("_", " ")


def _line(name: str, index: int) -> uplot.Series:
    return uplot.Series(label=name, stroke=theme.css(_PALETTE[index % len(_PALETTE)]), width=1.6, spanGaps=True)


def _dots(name: str) -> uplot.Series:
    color = theme.css(theme.LOOP)
    points = uplot.Series_Points(show=True, size=9, fill=color, stroke=color, width=2)
    return uplot.Series(label=name, stroke=color, width=0, points=points)


def _axes() -> tuple[uplot.Axis, ...]:
    """Frames have whole numbers."""
    grid = uplot.Axis_Grid(stroke="rgba(128,128,128,0.18)", width=1)
    ticks = uplot.Axis_Ticks(stroke="rgba(128,128,128,0.3)", width=1)
    style = {"stroke": "rgb(128,134,146)", "grid": grid, "ticks": ticks, "font": "11px system-ui"}
    x, y = {"size": X_AXIS_PX, "incrs": _WHOLE, **style}, {"size": Y_AXIS_PX, **style}
    return uplot.Axis(**x), uplot.Axis(**y)  # type: ignore[typeddict-item]
