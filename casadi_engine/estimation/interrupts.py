"""Ctrl-C during an estimation: the first asks for an early end, the second ends at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import Any


class Interrupts:
    """Notes the first Ctrl-C in ``stopped`` for as long as the context is open; a second one, ``twice``, raises.

    Inside another one it takes what comes, and hands it on when it closes.

    on_stop : called at the first Ctrl-C, between any two steps of the program

    An exception that is raised while CasADi converts arguments would be lost or turned into another one: a note is
    looked at between iterations instead. Outside the main thread nothing is changed.
    """

    def __init__(self, on_stop: Callable[[], None] | None = None) -> None:
        self.stopped, self.twice, self._on_stop = False, False, on_stop
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Interrupts:
        if self._main:
            self._old = signal.getsignal(signal.SIGINT)
            signal.signal(signal.SIGINT, self._note)
        return self

    def _note(self, *_: Any) -> None:
        self.stopped = True
        signal.signal(signal.SIGINT, self._again)
        if self._on_stop is not None:
            self._on_stop()

    def _again(self, *_: Any) -> None:
        self.twice = True
        raise KeyboardInterrupt

    def __exit__(self, *_: object) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._old)
            outer = getattr(self._old, "__self__", None)
            if self.stopped and isinstance(outer, Interrupts):
                outer.twice = self.twice or outer.stopped
                if not outer.stopped:
                    outer._note()
