"""The person at the terminal: lines to read, keys to press."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Protocol

from robust_instant_policy.robots.signals import StopRequest

ENTER = "\n"
WAIT_S = 0.02  # between two looks at the keyboard
CLOSED = "the terminal was closed"


class Operator(Protocol):
    """``stop`` is set when the person wants everything to stop."""

    stop: StopRequest

    def say(self, line: str) -> None: ...

    def pressed(self, keys: str) -> str:
        """Those of ``keys`` that were pressed since the last call, in their order. Does not wait."""
        ...

    def ask(self, line: str, keys: str) -> str:
        """Say a line, and wait for one of ``keys``; "" once a stop was requested."""
        ...


class Terminal:
    """An `Operator` on standard input: single keys of a terminal, or a pipe's lines, of which the first letter counts.

    A context manager. The end of the input is a request to stop.
    """

    def __init__(self, stop: StopRequest, say: Callable[[str], object]):
        self.stop, self._print = stop, say
        self._input = sys.stdin.fileno()
        self._settings: list | None = None
        self._typed, self._line, self._ended = "", "", False

    def __enter__(self) -> Terminal:
        if os.isatty(self._input):
            self._settings = termios.tcgetattr(self._input)
            tty.setcbreak(self._input)
        return self

    def __exit__(self, *_: object) -> None:
        if self._settings is not None:
            termios.tcsetattr(self._input, termios.TCSADRAIN, self._settings)

    def say(self, line: str) -> None:
        self._print(line)

    def pressed(self, keys: str) -> str:
        self._look()
        found = "".join(key for key in self._typed if key in keys)
        self._typed = "".join(key for key in self._typed if key not in keys)
        if self._ended and not found:
            self.stop(CLOSED)
        return found

    def ask(self, line: str, keys: str) -> str:
        self.say(line)
        if self._settings is not None:
            self._typed = ""  # pressed before the question
        while not self.stop.reason:
            found = self.pressed(keys)
            if found:
                self._typed = found[1:] + self._typed
                return found[0]
            time.sleep(WAIT_S)
        return ""

    def _look(self) -> None:
        while not self._ended and select.select([self._input], [], [], 0)[0]:
            content = os.read(self._input, 256).decode(errors="replace").replace("\r", ENTER)
            self._ended = not content
            if self._settings is not None:
                self._typed += content
            else:
                *lines, self._line = (self._line + content).split(ENTER)
                self._typed += "".join(line.strip()[:1] or ENTER for line in lines)
