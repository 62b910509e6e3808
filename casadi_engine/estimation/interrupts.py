"""Ctrl-C during an estimation: the first asks for an early end, the second ends at once."""

from __future__ import annotations

import signal
import threading
from typing import Any


class Interrupts:
    """Notes the first Ctrl-C in ``stopped`` for as long as the context is open; a second one raises as usual.

    An exception that is raised while CasADi converts arguments would be lost or turned into another one: a note is
    looked at between iterations instead. Outside the main thread nothing is changed.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Interrupts:
        if self._main:
            self._old = signal.getsignal(signal.SIGINT)
            signal.signal(signal.SIGINT, self._note)
        return self

    def _note(self, *_: Any) -> None:
        self.stopped = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def __exit__(self, *_: object) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._old)
