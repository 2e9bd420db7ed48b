"""What a run is to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..config import Config
from ..datasets import Live
from ..types import Sequence
from .control import ENDLESS


@dataclass(frozen=True)
class Plan:
    """address: what ``open_sequence`` takes; frames: the ``A:B:STEP`` asked for, "" = all; out: the run folder."""

    config: Config
    sequence: Sequence
    address: str
    frames: str
    device: str
    out: Path

    @property
    def live(self) -> Live | None:
        """The sequence, while its camera is on, or where that has brought nothing."""
        s = self.sequence
        return s if isinstance(s, Live) and not (s.over() and len(s)) else None

    @property
    def total(self) -> int:
        """How many frames there are to do; no end of them while a camera is on."""
        return len(self.sequence) if self.live is None else ENDLESS
