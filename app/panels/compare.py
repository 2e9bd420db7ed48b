"""Two runs side by side: the other one's trajectory and mesh in the scene, both runs' figures in a table."""

from __future__ import annotations

from html import escape

from ecslam.messages import Event, MeshReady, RequestMesh, Snapshot
from ecslam.types import InputError

from .. import theme
from ..hub import Hub
from ..panel import BasePanel
from ..past import Past
from ..runs import Run, drawable_mesh

_FIGURES = (
    ("preset", "preset", None),
    ("ended", "ended", None),
    ("ate_rmse_cm", "ATE RMSE, cm", 2),
    ("ate_max_cm", "ATE max, cm", 2),
    ("fps_wall", "frames/s, wall", 1),
    ("fps_engine", "frames/s, engine", 1),
    ("peak_memory_mb", "peak memory, MB", 0),
    ("frames", "frames", 0),
    ("keyframes", "keyframes", 0),
    ("loop_closures", "loops closed", 0),
    ("lost_frames", "frames lost", 0),
    ("depth_l1_cm", "Depth L1, cm", 2),
    ("accuracy_cm", "Accuracy, cm", 2),
    ("completion_cm", "Completion, cm", 2),
    ("completion_ratio", "Completion ratio, %", 1),
)


class Panel(BasePanel):
    """Comparison with the second run of ``ecslam view RUN1 RUN2``."""

    tab, order = "Run", 20

    @classmethod
    def applies(cls, hub: Hub) -> bool:
        return hub.replay is not None and bool(hub.replay.others)

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        assert hub.replay is not None
        gui, self._run, self._other = hub.server.gui, hub.replay.run, hub.replay.others[0]
        self._shown = (self._run.name, self._other.name) if self._run.name != self._other.name else ("First", "Second")
        gui.add_html(figures_table(self._run, self._other, self._shown))
        self._mesh_of = gui.add_dropdown("Mesh of", self._shown)
        self._past = Past(self._other.rows, self._other.trajectory)
        hub.on(self._mesh_of, lambda event: hub.submit(RequestMesh(0.0)))

    def snapshot(self, s: Snapshot) -> None:
        self.hub.scene.compare(self._past.trajectory(self._other.row_at(s.frame))[:, :3, 3])

    def event(self, event: Event) -> None:
        """A mesh of the first run has come; show the second one's of that frame instead where it is wanted."""
        path = self._other.mesh_at(event.frame) if isinstance(event, MeshReady) else None
        if path is None or self._mesh_of.value != self._shown[1]:
            return
        try:
            self.hub.scene.show_mesh(drawable_mesh(path))
        except InputError as error:
            self.hub.toast("No mesh", str(error), "red")


def figures_table(a: Run, b: Run, names: tuple[str, str]) -> str:
    """The figures that at least one of two runs has, as an HTML table, and which path is whose."""
    rows = "".join(
        f"<tr><td>{label}</td><td>{_text(a, key, digits)}</td><td>{_text(b, key, digits)}</td></tr>"
        for key, label, digits in _FIGURES
        if a.summary.get(key) is not None or b.summary.get(key) is not None
    )
    heads = "<th></th>" + "".join(f"<th>{escape(name)}</th>" for name in names)
    paths = theme.legend([(f"path of {names[0]}", theme.ESTIMATE), (f"path of {names[1]}", theme.OTHER)])
    return theme.card(f"<table><tr>{heads}</tr>{rows}</table>{paths}")


def _text(run: Run, key: str, digits: int | None) -> str:
    value = run.summary.get(key)
    return escape(str(value or "–")) if digits is None or not isinstance(value, (int, float)) else f"{value:.{digits}f}"
