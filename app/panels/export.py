"""Taking away: mesh, trajectory, keyframes, configuration, the whole run, a screenshot, an HTML replay."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import viser

from ecslam.messages import Export, Snapshot

from .. import theme
from ..hub import Hub
from ..panel import BasePanel
from ..record import html_replay

SCREENSHOT_TIMEOUT_S = 30.0
KEYFRAMES = "The poses of the keyframes alone, in TUM's format"
ZIP = "The run's folder without its checkpoints; ecslam view opens it again"
CONFIGURATION = "All settings in force, as YAML; --config takes them"
SCREENSHOT = "The scene as you see it, without this panel"
REPLAY = "A page that plays the run by itself, without anything installed"


def what_is_exported(s: Snapshot) -> str:
    """Which frames of a replay the exports are of."""
    return (
        f"Mesh, poses and zip are of the whole run, frames 0 to {s.frames_total - 1}. "
        f"Screenshot and HTML replay are of what is shown, frame {s.frame}."
    )


class Panel(BasePanel):
    """Every file also stays in the run folder; the toast says where. A finished run's mesh has the voxels it has."""

    tab, order = "Export", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui = hub.server.gui
        self._whole = gui.add_html("", visible=False)
        with gui.add_folder("Mesh"):
            mesh = gui.add_dropdown("Format", ("PLY", "GLB", "OBJ"))
            voxel = gui.add_slider("Voxel size (cm)", 1.0, 10.0, 0.5, 2.0, visible=hub.replay is None)
            hub.commands(
                gui.add_button("Export mesh", icon=viser.Icon.DOWNLOAD),
                lambda: Export("mesh", mesh.value.lower(), voxel.value / 100),
            )
        with gui.add_folder("Poses"):
            poses = gui.add_dropdown("Format", ("TUM", "KITTI"))
            hub.commands(
                gui.add_button("Export trajectory", icon=viser.Icon.DOWNLOAD),
                lambda: Export("trajectory", poses.value.lower()),
            )
            hub.commands(self._button("Export keyframes", viser.Icon.DOWNLOAD, KEYFRAMES), lambda: Export("keyframes"))
        with gui.add_folder("Everything else"):
            hub.commands(self._button("Export run as zip", viser.Icon.FILE_ZIP, ZIP), lambda: Export("run", "zip"))
            hub.commands(
                self._button("Export configuration", viser.Icon.SETTINGS, CONFIGURATION), lambda: Export("config")
            )
            hub.on(self._button("Save screenshot", viser.Icon.CAMERA, SCREENSHOT), self._later(self._screenshot))
            hub.on(self._button("Save HTML replay", viser.Icon.MOVIE, REPLAY), self._later(self._replay))
        self._where = gui.add_html("")
        self.begin()

    def _button(self, label: str, icon: viser.IconName, hint: str) -> viser.GuiButtonHandle:
        return self.hub.server.gui.add_button(label, icon=icon, color="gray", hint=hint)

    def begin(self) -> None:
        """Say where the run's files lie."""
        folder = escape(str(self.hub.engine.run_folder.resolve()))
        self._where.content = theme.card(f'<span class="dim">Run folder: {folder}</span>')

    def snapshot(self, s: Snapshot) -> None:
        """A replay that is not at its end exports what one does not see."""
        if self.hub.replay is not None:
            self._whole.content = theme.card(theme.note(what_is_exported(s), theme.KEYFRAME))
            self._whole.visible = s.frame + 1 < s.frames_total

    def _later(self, job: Any) -> Any:
        """An action that runs ``job(client)`` aside and delivers the file it returns."""

        def run(client: Any, note: Any) -> None:
            try:
                self.hub.deliver(client, job(client))
            except (OSError, RuntimeError, TimeoutError) as error:
                self.hub.toast("Not saved", str(error), "red", client)
            finally:
                note.remove()

        def begin(event: Any) -> None:
            note = self.hub.under_way(f"{event.target.label} …", event.client)
            self.hub.jobs.submit(run, event.client, note)

        return begin

    def _path(self, name: str) -> Path:
        folder = self.hub.engine.run_folder / "exports"
        folder.mkdir(parents=True, exist_ok=True)
        frame = 0 if self.hub.current is None else self.hub.current.frame
        return folder / name.format(frame=frame)

    def _screenshot(self, client: Any) -> Path:
        height, width = client.camera.image_height, client.camera.image_width
        picture = client.get_render(height, width, transport_format="png", timeout=SCREENSHOT_TIMEOUT_S)
        path = self._path("screenshot-{frame:06d}.png")
        iio.imwrite(path, picture)
        return path

    def _replay(self, client: Any) -> Path:
        if self.hub.current is None:
            raise RuntimeError("there is nothing to replay before the first frame")
        path = self._path("replay-{frame:06d}.html")
        path.write_text(html_replay(self.hub.current, self.hub.scene.mesh, self.hub.history, self.hub.dark), "utf-8")
        return path
