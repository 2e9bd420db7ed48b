"""The command ``ecslam``, also as ``python -m ecslam``: whatever it is doing, Ctrl-C ends it without a traceback."""

from __future__ import annotations

import sys
from types import TracebackType

INTERRUPTED = 130


def main() -> None:
    """Entry point. Ctrl-C ends the process as that signal does by itself, so that a shell's loop around it ends too."""
    sys.excepthook = _report
    from .cli import main as command

    try:
        command()
    except SystemExit as end:
        if end.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        raise


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if not issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)


if __name__ == "__main__":
    main()
