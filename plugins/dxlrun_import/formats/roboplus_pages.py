"""Pages of a motion file of RoboPlus, as the file has them; `roboplus.py` converts them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from dxlrun.tooling.files import FileContent, Mark
from dxlrun_import.checked_values import refused

USUAL_COMPLIANCE = 5  # of a slope of 32, the default of an AX-12
BY_HAND = "write its motions by hand; docs/how-to/import.md"


@dataclass
class MotionPage:
    """Page of a motion file."""

    mark: Mark
    number: int
    title: str = ""
    compliance: Sequence[float] = ()
    param: Sequence[float] = (0, 0, 1, 1, 32)
    steps: list[list[float]] = field(default_factory=list)
    name: str = ""
    follower: MotionPage | None = None
    exit: MotionPage | None = None

    def compliance_of(self, servo_id: int) -> float:
        """Return the compliance of a servo on this page; the usual one if the page has none."""
        return self.compliance[servo_id] if servo_id < len(self.compliance) else USUAL_COMPLIANCE


def read_pages(content: FileContent) -> tuple[list[float], list[MotionPage]]:
    """Return the flags of the IDs in use, and the pages. Raises InputError with the line."""
    flags: list[float] = []
    pages: list[MotionPage] = []
    is_open = False
    # Names of pages are in the encoding of the Windows that wrote the file, numbers in its locale.
    text = content.data.decode("utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        mark = Mark(str(content.path), number, 1)
        key, _, value = line.strip().partition("=")
        if key in ("page_begin", "page_end"):
            is_open = key == "page_begin"
            pages += [MotionPage(mark, len(pages) + 1)] * is_open
        elif key == "enable":
            flags = _numbers(value, mark)
        elif key == "motor_type" and any(_numbers(value, mark)):
            raise refused(mark, "it has servos other than AX", BY_HAND)
        elif key == "name" and pages:
            pages[-1].title = value
        elif key == "step" and pages:
            pages[-1].steps.append(_numbers(value, mark, len(flags) + 2))
        elif key in ("compliance", "play_param") and pages:
            count = 5 if key == "play_param" else None
            setattr(pages[-1], key.removeprefix("play_"), _numbers(value, mark, count))
    if is_open:
        raise refused(pages[-1].mark, "this page has no page_end: the file is cut off", "export it again")
    return flags, pages


def _numbers(text: str, mark: Mark, count: int | None = None) -> list[float]:
    try:
        found = [float(word.replace(",", ".")) for word in text.split()]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        raise refused(mark, f"{text:.40} is not a list of numbers", "export the file again")
    if count not in (None, len(found)):
        raise refused(mark, f"{len(found)} numbers are here, but must be {count}", "export the file again")
    return found
