"""Finding: what the doctor says about one thing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["good", "worse", "missing"]
"""worse: robots run, but not as smoothly as they could; missing: no robot runs like this."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    what: str
    state: State
    found: str
    """How it is here."""
    why: str
    """What it matters for."""
    mend: str = ""
    """The command, or the step, that mends it; empty where nothing is to be mended."""
