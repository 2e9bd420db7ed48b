"""The one thread that owns the page: it takes snapshots, events and clicks from an inbox and updates scene and panels.

Browser callbacks write nothing. They either submit a command to the engine at once or post an action here.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import viser

from ecslam.messages import (
    Ack,
    Command,
    Event,
    Export,
    Exported,
    LoopEvent,
    MeshReady,
    Notice,
    RequestMesh,
    Snapshot,
)
from ecslam.runtime.protocol import EngineHandle
from ecslam.runtime.runfolder import frame_rows

from . import hints, theme
from .broadcast import downloading
from .history import History, history_of, with_last_mapping
from .panel import TABS, BasePanel, find_panels
from .replay import ReplayEngine
from .scene import Scene
from .views import Views

log = logging.getLogger(__name__)

# Every viewer's socket must be written to, so more viewers get fewer updates and the engine keeps its pace.
REFRESH_S, REFRESH_PER_VIEWER_S = 0.12, 0.01
RESHAPED = 0.05
TOAST_CHARACTERS, NOTICE_EVERY_S = 240, 2.0
LONGEST_JOB_S = 120.0
DOWNLOAD_LIMIT = 256 * 1024 * 1024


class Hub:
    """Connects an engine to a viser server. ``start`` builds the page, ``close`` ends it."""

    def __init__(self, engine: EngineHandle, server: viser.ViserServer, dark: bool) -> None:
        self.engine, self.server, self.dark = engine, server, dark
        self.scene = Scene(server, self._keyframe_clicked)
        self.views = Views(server, self.scene)
        self.replay = engine if isinstance(engine, ReplayEngine) else None
        self.history = History() if self.replay is None else self.replay.history
        self.current: Snapshot | None = None
        self.jobs = ThreadPoolExecutor(2, "dashboard-job")
        self._askers: dict[int, viser.ClientHandle] = {}
        self._under_way: dict[int, viser.NotificationHandle] = {}
        self._asking = threading.Lock()
        self._inbox: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._subscription = engine.subscribe()
        self._woken = False
        self._shown: Snapshot | None = None
        self._noticed = 0.0
        self._closing = False
        self.panels: list[BasePanel] = []
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._listen, self._work)]

    # ---- life ----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Build the panels and begin to show."""
        self.theme()
        self.server.gui.main_panel.dock_right()
        self.server.gui.main_panel.set_width(372)
        found = [panel for panel in find_panels() if panel.applies(self)]
        self.panels += [panel(self) for panel in found if not panel.tab]
        group = self.server.gui.add_tab_group()
        for tab in TABS:
            members = [panel for panel in found if panel.tab == tab]
            if members:
                with group.add_tab(tab):
                    self.panels += [panel(self) for panel in members]
        hints.tell(self.server.gui)
        self.server.on_client_connect(self._connected)
        self._ring()
        if self.replay is not None:
            self.submit(RequestMesh(0.0))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop showing; the engine goes on."""
        self._closing = True
        self._subscription.close()
        self._inbox.put(None)
        self.jobs.shutdown(wait=False, cancel_futures=True)
        for thread in self._threads:
            if thread.is_alive():
                thread.join(3)

    def theme(self) -> None:
        """Send colours and layout to the browsers."""
        self.server.gui.configure_theme(
            dark_mode=self.dark,
            show_logo=False,
            show_share_button=False,
            control_width="large",
            brand_color=theme.ACCENT,
        )
        self.scene.set_dark(self.dark)
        self.views.walls.set_dark(self.dark)

    # ---- what panels use -----------------------------------------------------------------------------------------

    def post(self, action: Callable[[], Any]) -> None:
        """Run ``action`` on the hub's thread, soon."""
        self._inbox.put(action)

    def submit(self, command: Command, client: viser.ClientHandle | None = None) -> int:
        """Send a command to the engine; ``client`` gets the toast about what became of it."""
        with self._asking:
            number = self.engine.submit(command)
            if client is not None:
                self._askers[number] = client
        return number

    def commands(self, button: Any, make: Callable[[], Command]) -> None:
        """Let a button submit what ``make`` builds, on the event loop, without waiting for anything."""

        async def clicked(event: Any) -> None:
            self.submit(make(), event.client)

        button.on_click(clicked)

    def on(self, handle: Any, action: Callable[[Any], Any]) -> None:
        """Run ``action(event)`` on the hub's thread when a browser changes or clicks a control."""

        async def changed(event: Any) -> None:
            if event.client is not None:
                self.post(partial(action, event))

        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(changed)

    def viewers(self) -> Iterable[viser.ClientHandle]:
        """The connected browsers."""
        return self.server.get_clients().values()

    def toast(self, title: str, text: str, color: str, client: viser.ClientHandle | None = None) -> None:
        """Tell one viewer something, or all of them."""
        brief = " ".join(text.split())
        brief = brief if len(brief) <= TOAST_CHARACTERS else f"{brief[:TOAST_CHARACTERS]} …"
        for viewer in [client] if client is not None else self.viewers():
            viewer.add_notification(title, brief, auto_close_seconds=8.0, color=color)  # type: ignore[call-overload]

    def under_way(self, text: str, client: viser.ClientHandle) -> viser.NotificationHandle:
        """Tell a viewer that something has begun; ``remove`` what comes back when it is done."""
        return client.add_notification("Working", text, loading=True, auto_close_seconds=LONGEST_JOB_S)

    def deliver(self, client: viser.ClientHandle | None, path: Path) -> None:
        """Say where a file lies and start its download in the browser of who asked for it."""
        size = path.stat().st_size
        text = f"{path}  ({theme.size(size)})"
        if client is None or client.client_id not in self.server.get_clients():
            return
        if size > DOWNLOAD_LIMIT:
            self.toast("Saved", f"{text}; too large to download here", "yellow", client)
            return
        if downloading(client):
            self.toast("Saved", f"{text}; not downloaded, as the last file is still on its way", "yellow", client)
            return
        client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        self.toast("Saved", text, "green", client)

    # ---- the two threads -----------------------------------------------------------------------------------------

    def _listen(self) -> None:
        while not self._closing:
            message = self._subscription.get(1.0)
            if self._subscription.overrun:
                self._subscription = self.engine.subscribe()
            if isinstance(message, Snapshot):
                self._ring()
            elif message is not None:
                self.post(partial(self._tell, message))

    def _ring(self) -> None:
        """There may be a newer snapshot; only the listener calls this once it runs."""
        if not self._woken:
            self._woken = True
            self.post(self._wake)

    def _work(self) -> None:
        shown, show_at = 0.0, None
        while True:
            try:
                wait = None if show_at is None else max(0.0, show_at - time.monotonic())
                action = self._inbox.get(timeout=wait)
            except queue.Empty:
                shown, show_at = time.monotonic(), None
                self._attempt(self._show)
                continue
            if action is None:
                return
            if action == self._wake:
                pause = REFRESH_S + REFRESH_PER_VIEWER_S * len(self.server.get_clients())
                show_at = show_at or max(time.monotonic(), shown + pause)
            else:
                self._attempt(action)

    def _wake(self) -> None:
        """Posted when a snapshot waits; the worker shows the newest when the page may be refreshed again."""

    def _attempt(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception:
            log.exception("the dashboard could not carry out %r", action)

    def _show(self) -> None:
        self._woken = False  # first, so that no newer one goes unnoticed
        s = self.engine.latest()
        if s is None or s is self._shown:
            return
        self._shown = s
        before = self.current
        restarted = before is not None and s.frame < before.frame and self.replay is None
        if before is None or restarted or before.sequence != s.sequence:
            self._begin(s)
        self.history.add_snapshot(s)
        self.current = s = with_last_mapping(s, before)
        with self.server.atomic():
            self.scene.update(s)
            for panel in self.panels:
                panel.snapshot(s)
        if len(s.trajectory):
            self.views.move_along(s.trajectory[-1])

    def _begin(self, s: Snapshot) -> None:
        if self.replay is None:
            self.history = history_of(frame_rows(self.engine.run_folder))
        self.scene.begin(s)
        self.views.begin()
        for panel in self.panels:
            panel.begin()

    def _tell(self, message: Event | Ack) -> None:
        if isinstance(message, Ack):
            self._acknowledged(message)
            return
        if isinstance(message, MeshReady):
            self._show()  # a new run clears the scene; its first mesh must not come before that
            self.scene.set_mesh(message)
            self.views.keep_framed()
        elif isinstance(message, Exported):
            self._exported(message, message.command_id or -1)
        elif isinstance(message, Notice):
            self._notice(message)
        elif isinstance(message, LoopEvent):
            self.toast("Loop closed", f"Frame {message.frame}: corrected by {message.correction_cm:.2f} cm", "teal")
        for panel in self.panels:
            panel.event(message)

    def _exported(self, message: Exported, command_id: int) -> None:
        asker, note = self._askers.pop(command_id, None), self._under_way.pop(command_id, None)
        if note is not None:
            note.remove()
        if message.error:
            self.toast("Not exported", f"{message.kind}: {message.error}", "red", asker)
        else:
            self.jobs.submit(self.deliver, asker, Path(message.path))

    def _notice(self, notice: Notice) -> None:
        now = time.monotonic()
        if notice.level == "error" or now - self._noticed > NOTICE_EVERY_S:
            self._noticed = now
            color = {"info": "blue", "warning": "yellow"}.get(notice.level, "red")
            self.toast(notice.level.capitalize(), notice.text, color)

    def _acknowledged(self, ack: Ack) -> None:
        with self._asking:
            waits = isinstance(ack.command, Export) and not ack.error
            asker = self._askers.get(ack.command_id) if waits else self._askers.pop(ack.command_id, None)
        if isinstance(ack.command, Export) and waits and asker is not None:
            text = f"Writing the {ack.command.kind}; the download starts by itself"
            self._under_way[ack.command_id] = self.under_way(text, asker)
        if ack.error:
            self.toast("Not done", ack.error, "red", asker)
        for panel in self.panels:
            panel.ack(ack)

    # ---- browsers ------------------------------------------------------------------------------------------------

    async def _connected(self, client: viser.ClientHandle) -> None:
        aspect = client.camera.aspect
        self.post(partial(self._welcome, client))

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            nonlocal aspect
            if abs(camera.aspect - aspect) > RESHAPED * aspect:
                aspect = camera.aspect
                self.post(partial(self.views.reshaped, client))

    def _welcome(self, client: viser.ClientHandle) -> None:
        self.views.welcome(client)
        for panel in self.panels:
            panel.viewer()

    def _keyframe_clicked(self, client: viser.ClientHandle, index: int) -> None:
        self.post(partial(self._visit, client, index))

    def _visit(self, client: viser.ClientHandle, index: int) -> None:
        if self.current is None or index >= len(self.current.keyframes):
            return
        if any(panel.takes_clicks(client) for panel in self.panels):
            return
        keyframe = self.current.keyframes[index]
        self.views.visit(client, keyframe.c2w)
        for panel in self.panels:
            panel.keyframe(keyframe)
