"""Awaits what another process does; how long that takes decides nothing but when to give up."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

DEADLINE_S = 300.0
"""Longer than most tests may take: beside 24 programs on two processors a run takes 70 s to start."""
Found = TypeVar("Found")


def until(condition: Callable[[], Found], awaited: object = "") -> Found:
    """Return what a condition has found as soon as that is true; `awaited` says what is missing if not."""
    end = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        assert time.monotonic() < end, awaited or condition
        time.sleep(0.02)
    return found
