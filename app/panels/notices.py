"""What a person should read about the run: frames skipped, tracking lost, files that could not be saved."""

from __future__ import annotations

import re
from collections import deque

from ecslam.messages import Ack, Event, Notice, Restart, Snapshot

from .. import theme
from ..hub import Hub
from ..panel import BasePanel
from ..runs import notices_in

MOST = 8
_COLORS = {"error": theme.BEFORE, "warning": theme.ESTIMATE}


class Panel(BasePanel):
    """The newest notices: a toast is gone after some seconds, and who opens the page later has not seen it. What the
    status card says already is left out."""

    tab, order = "Run", 90

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        noted = notices_in(hub.engine.run_folder)
        self._newest, self._count, self._said = deque(noted, MOST), len(noted), ""
        self._html = hub.server.gui.add_html("", visible=False)
        self._show()

    def snapshot(self, s: Snapshot) -> None:
        """What is going on before the first frame is done is no news any more after that."""
        over = [n for n in self._newest if s.reported is not None and n.level == "info" and n.frame is None]
        for notice in over:
            self._newest.remove(notice)
        self._count -= len(over)
        if over or s.reason != self._said:
            self._said = s.reason
            self._show()

    def event(self, event: Event) -> None:
        if isinstance(event, Notice) and event not in self._newest:
            self._newest.append(event)
            self._count += 1
            self._show()

    def ack(self, ack: Ack) -> None:
        """A restart goes into a folder of its own, and begins without the notices of the run before."""
        if isinstance(ack.command, Restart) and not ack.error:
            self._newest.clear()
            self._count = 0
            self._show()

    def _show(self) -> None:
        self._html.content = text = self._text()
        self._html.visible = bool(text)

    def _text(self) -> str:
        notes = [
            theme.note(_words(n), _COLORS.get(n.level, theme.KEYFRAME))
            for n in reversed(self._newest)
            if not self._said.endswith(n.text)
        ]
        earlier = self._count - len(self._newest)
        if not notes and not earlier:
            return ""
        more = f'<span class="dim">and {earlier} before these, in events.jsonl</span>' if earlier else ""
        return theme.card(f"<b>Notices</b>{''.join(notes)}{more}")


def _words(notice: Notice) -> str:
    """The text, after the number of the frame that it is about where it does not name that itself."""
    told = notice.frame is None or re.search(rf"\bframe {notice.frame}\b", notice.text)
    return notice.text if told else f"Frame {notice.frame}: {notice.text}"
