"""Six pictures of the current frame or of a keyframe: colour and depth as input, rendered, and their difference."""

from __future__ import annotations

import base64
import time

import cv2
import numpy as np
from numpy.typing import NDArray

from ecslam.messages import Event, FramePictures, KeyframeView, RequestPictures, Snapshot, State

from ..hub import Hub
from ..panel import BasePanel

LEAST_S, MOST_S = 3.0, 20.0  # between two requests; the first pictures compile what renders them, and say little
LIVE = "Pictures of the newest frame while the run goes on"
BACK = "Where the run is, after a keyframe that was clicked"
SHARE = 0.03  # of the engine's time
_ORDER = (
    ("color", "colour"),
    ("depth", "depth"),
    ("color_rendered", "colour, rendered"),
    ("depth_rendered", "depth, rendered"),
    ("color_difference", "colour, difference"),
    ("depth_difference", "depth, difference"),
)


class Panel(BasePanel):
    """The pictures; the engine renders them between two frames, so it is asked seldom, the slower it is the more so."""

    tab, order = "Pictures", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui = hub.server.gui
        self._html = gui.add_html(_message("No pictures yet." if hub.replay is None else "This run kept no pictures."))
        self._asked, self._asked_frame, self._keyframe = 0.0, -1, False
        self._pause_s = LEAST_S
        if hub.replay is None:
            self._live = gui.add_checkbox("Live", True, hint=LIVE)
            hub.on(gui.add_button("Show current frame", color="gray", hint=BACK), self._show_current)

    def snapshot(self, s: Snapshot) -> None:
        if self.hub.replay is not None:
            self._show_kept(s)
            return
        due = time.monotonic() - self._asked > self._pause_s or s.state in (State.PAUSED, State.FINISHED)
        looked_at = self._live.value and not self._keyframe and bool(self.hub.server.get_clients())
        if looked_at and due and s.keyframes and s.frame != self._asked_frame:
            self._asked, self._asked_frame = time.monotonic(), s.frame
            self.hub.submit(RequestPictures())

    def viewer(self) -> None:
        """A run that stands still sends no snapshot that would bring pictures."""
        if self.hub.current is not None:
            self.snapshot(self.hub.current)

    def event(self, event: Event) -> None:
        if isinstance(event, FramePictures):
            self._pause_s = min(max(LEAST_S, event.took_s / SHARE), MOST_S)
            figures = "".join(_figure(getattr(event, field), name) for field, name in _ORDER)
            title = f"Keyframe {event.frame}" if self._keyframe else f"Frame {event.frame}"
            self._html.content = f'<div class="ec"><b>{title}</b><div class="ec-six">{figures}</div></div>'

    def keyframe(self, keyframe: KeyframeView) -> None:
        self._keyframe = True
        jpeg = keyframe.jpeg()
        figure = _image(jpeg, "colour") if jpeg else ""
        self._html.content = f'<div class="ec"><b>Keyframe {keyframe.frame}</b><div class="ec-six">{figure}</div></div>'
        if self.hub.replay is None:
            self.hub.submit(RequestPictures(keyframe.frame))

    def _show_kept(self, s: Snapshot) -> None:
        """Of a finished run there are its keyframes' pictures: show the newest one when that changes."""
        newest = s.keyframes[-1] if s.keyframes else None
        if newest is not None and newest.picture and newest.frame != self._asked_frame:
            self._asked_frame = newest.frame
            self.keyframe(newest)

    def _show_current(self, event: object) -> None:
        self._keyframe = False
        self.hub.submit(RequestPictures())


def _figure(picture: NDArray[np.uint8], name: str) -> str:
    _, data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    return _image(data.tobytes(), name)


def _image(jpeg: bytes, name: str) -> str:
    text = base64.b64encode(jpeg).decode()
    return f'<figure><img src="data:image/jpeg;base64,{text}" alt="{name}"><figcaption>{name}</figcaption></figure>'


def _message(text: str) -> str:
    return f'<div class="ec dim">{text}</div>'
