"""What a panel is, and how panels are found: every module in ``panels/`` that holds a class ``Panel``."""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Any, ClassVar

import viser

from ecslam.messages import Ack, Event, KeyframeView, Snapshot

from . import panels

if TYPE_CHECKING:
    from .hub import Hub

TABS = ("Run", "Plots", "Pictures", "Loops", "Export", "View")


class BasePanel:
    """One section of the dashboard. A subclass builds its controls in ``__init__`` and overrides what it shows.

    tab: the tab it lives in, one of ``TABS``, or "" for above the tabs. order: position within the tab.
    All methods run on the hub's thread.
    """

    tab: ClassVar[str] = "Run"
    order: ClassVar[int] = 0

    def __init__(self, hub: Hub) -> None:
        self.hub = hub

    @classmethod
    def applies(cls, hub: Hub) -> bool:
        """Whether this panel has anything to offer for the hub's engine."""
        return True

    def snapshot(self, s: Snapshot) -> None:
        """Show a new state; called at most a few times a second."""

    def event(self, event: Event) -> None:
        """React to an event."""

    def ack(self, ack: Ack) -> None:
        """React to the engine's answer to a command."""

    def viewer(self) -> None:
        """A browser has opened the page."""

    def keyframe(self, keyframe: KeyframeView) -> None:
        """A viewer has clicked a keyframe's frustum."""

    def begin(self) -> None:
        """Another run begins, in a world of its own."""

    def takes_clicks(self, client: viser.ClientHandle) -> bool:
        """Whether a viewer's clicks are for this panel, so that none of them flies to a keyframe."""
        return False


def put(control: Any, value: Any) -> None:
    """Set the value of a control on the page. (viser's setter is invisible to type checkers.)"""
    control.value = value


def find_panels() -> list[type[BasePanel]]:
    """All panel classes, in the order in which they are shown."""
    modules = [importlib.import_module(f"{panels.__name__}.{m.name}") for m in pkgutil.iter_modules(panels.__path__)]
    return sorted((m.Panel for m in modules), key=lambda p: (TABS.index(p.tab) if p.tab else -1, p.order))
