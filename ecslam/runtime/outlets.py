"""Outputs that end before a command does: a pipe that is closed, a disk that is full, a terminal that is gone."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


@contextmanager
def lasting_outputs() -> Iterator[list[OSError]]:
    """Within the block, what standard output or standard error no longer takes is dropped, from any thread; why, is in
    the list."""
    before = sys.stdout, sys.stderr
    refused: list[OSError] = []
    sys.stdout, sys.stderr = (each and cast(TextIO, _Lasting(each, refused)) for each in before)
    try:
        yield refused
    finally:
        with suppress(AttributeError):  # closed from the start
            sys.stdout.flush()
        sys.stdout, sys.stderr = before


class _Lasting:
    """A stream that, the first time it cannot be written, says so on standard error and goes nowhere from then on."""

    def __init__(self, stream: TextIO, refused: list[OSError]) -> None:
        self._stream, self._refused = stream, refused

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError as error:
            self._end(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._end(error)

    def _end(self, error: OSError) -> None:
        self._refused.append(error)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        told = f"note: the output takes no more ({error.strerror}); nothing more is printed"
        print(told, file=sys.stderr, flush=True)
