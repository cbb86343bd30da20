"""Awaits what another process does; how long that takes decides nothing but when to give up.

This is the only place with deadlines: a shorter one in a test fails on a busy machine alone.
"""

import time
from collections.abc import Callable
from typing import TypeVar

DEADLINE_S = 3600.0
"""Longer than a test may take, whose limit shows where it hangs and grows with the load: beside
24 programs on two processors a run takes 70 s to start."""
Found = TypeVar("Found")


def until(
    condition: Callable[[], Found],
    awaited: object = "",
    *,
    check: Callable[[], object] = lambda: None,
    pause_s: float = 0.02,
) -> Found:
    """Return what a condition has found as soon as that is true.

    Args:
        condition: Called again and again.
        awaited: What is missing at the deadline; a function is called for it.
        check: Called in each round; asserts that waiting still makes sense, such as that a process lives.
        pause_s: Pause between two rounds.
    """
    end = time.monotonic() + DEADLINE_S
    while not (found := condition()):
        check()
        assert time.monotonic() < end, (awaited() if callable(awaited) else awaited) or condition
        time.sleep(pause_s)
    return found
