"""Recorded motion: positions or goals of several joints over time, cut and renamed by the user's options.

Input errors are reported all at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import ROTARY, InputError, JointUnit
from dxlrun.tooling.files import suggestion

Floats: TypeAlias = NDArray[np.float64]
What: TypeAlias = Literal["goals", "states"]

LONGEST_HOLE_S = 1.0
"""Longest time without a recorded position of a joint in a motion; a longer hole is an error."""
MOST_NUMBERS = 8_000_000  # Moments x joints of a motion: 64 MB, 20 joints at 100 Hz for an hour


class Series(msgspec.Struct, frozen=True, eq=False):
    """Recorded positions or goals of one joint over time."""

    time_s: Floats  # Shape (moments,), s since the start of the recording
    position: Floats  # Shape (moments,), rad (m for a linear joint)
    what: What  # Goals that were sent, or measured states
    continued: bool = False
    """True if positions are interpolated however far apart they are, as between points of a trajectory;
    otherwise a long hole is an error."""
    unit: JointUnit = ROTARY  # Unit of the positions

    def ordered(self) -> Series:
        """Return a copy with the finite positions in order of time; of several at one time, the last."""
        known = np.flatnonzero(np.isfinite(self.position) & np.isfinite(self.time_s))
        order = known[np.argsort(self.time_s[known], kind="stable")]
        time = self.time_s[order]
        last = np.ones(len(time), dtype=np.bool_)
        last[:-1] = time[1:] > time[:-1]
        return replace(self, time_s=time[last], position=self.position[order][last])

    def between(self, begin_s: float, end_s: float) -> Series:
        """Return the positions between two times (s), both included."""
        inside = slice(*np.searchsorted(self.time_s, (begin_s, np.nextafter(end_s, math.inf))))
        return replace(self, time_s=self.time_s[inside], position=self.position[inside])


class RecordedMotion(msgspec.Struct, frozen=True, eq=False):
    """Positions of several joints at common times, with the recording that they come from."""

    path: Path
    joints: tuple[str, ...]
    what: tuple[What, ...]  # By joint
    time_s: Floats  # Shape (moments,), ascending, from 0
    position: Floats  # Shape (moments, joints), rad (m for linear joints)
    begin_s: float  # Start of the motion in the recording
    units: tuple[JointUnit, ...]  # Units of the joints, from the plan of the run
    remarks: tuple[str, ...] = ()  # One sentence for each problem of reading
    plan: bytes | None = None  # Plan of the run, as JSON; None for a foreign recording

    @property
    def duration_s(self) -> float:
        """Time from the first moment to the last, s."""
        return float(self.time_s[-1])


class Stretch(msgspec.Struct, frozen=True):
    """Part of a recording that `--from` and `--to` select, s since its start; None: its start or end."""

    begin_s: float | None = None
    end_s: float | None = None

    def validate_times(self) -> None:
        """Check that the times are valid.

        Raises:
            InputError: A time is negative or not finite, or the start is not before the end.
        """
        for option, value in (("--from", self.begin_s), ("--to", self.end_s)):
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InputError(f"{option} {value:g}: give seconds since the start of the recording")
        if self.begin_s is not None and self.end_s is not None and self.begin_s >= self.end_s:
            raise InputError(f"--from {self.begin_s:g} is not before --to {self.end_s:g}; swap them")


WHOLE = Stretch()


def parse_names(words: Sequence[str]) -> dict[str, str]:
    """Parse the values of the option `--map RECORDED=JOINT`.

    Returns:
        Joint by recorded name; an empty joint omits the recorded one.

    Raises:
        InputError: All words with a mistake.
    """
    names: dict[str, str] = {}
    mistakes: list[str] = []
    for word in words:
        recorded, sign, joint = word.partition("=")
        if not (recorded and sign):
            mistakes.append(f"--map {word}: write RECORDED=JOINT, or RECORDED= to omit a joint")
        elif recorded in names:
            mistakes.append(f"--map {recorded} is given twice; give it once")
        names[recorded] = joint
    if mistakes:
        raise InputError("\n".join(mistakes))
    return names


def chosen(path: Path, series: Mapping[str, Series], only: Sequence[str]) -> dict[str, Series]:
    """Return those series whose joints the option `--joint` names (`only`), or all if it is empty.

    Raises:
        InputError: The recording has no joint of a name.
    """
    wrong = [
        f"{path}: --joint {name}: the recording has no joint {name}; {suggestion(name, tuple(series))}"
        for name in only
        if name not in series
    ]
    if wrong:
        raise InputError("\n".join(wrong))
    return {name: one for name, one in series.items() if not only or name in only}


def motion_of(
    path: Path, series: Mapping[str, Series], stretch: Stretch, names: Mapping[str, str]
) -> RecordedMotion:
    """Combine series by recorded joint into one motion over their common time, within `stretch`, with joints
    renamed by `names`.

    Raises:
        InputError: All reasons why the series do not form one motion.
    """
    wrong = [
        f"{path}: --map {name}: the recording has no joint {name}; {suggestion(name, tuple(series))}"
        for name in names
        if name not in series
    ]
    known = {name: names.get(name, name) for name in series}
    taken = [joint for joint in known.values() if joint]
    wrong += [
        f"{path}: --map gives several recorded joints the name {joint}; omit all but one by RECORDED="
        for joint in dict.fromkeys(taken)
        if taken.count(joint) > 1
    ]
    if wrong:
        raise InputError("\n".join(wrong))
    kept = {joint: series[name].ordered() for name, joint in known.items() if joint}
    return _joined(path, kept, stretch)


def _joined(path: Path, series: Mapping[str, Series], stretch: Stretch) -> RecordedMotion:
    if not series:
        raise InputError(f"{path}: no joint is left to play; keep at least one")
    silent = [joint for joint, one in series.items() if not len(one.time_s)]
    if silent:
        raise InputError(f"{path}: the recording has no position of {', '.join(silent)}")
    first_s = max(float(one.time_s[0]) for one in series.values())
    last_s = min(float(one.time_s[-1]) for one in series.values())
    begin_s = first_s if stretch.begin_s is None else max(first_s, stretch.begin_s)
    end_s = last_s if stretch.end_s is None else min(last_s, stretch.end_s)
    if end_s <= begin_s:
        raise InputError(
            f"{path}: no motion between --from and --to; choose times from {first_s:.3f} s to {last_s:.3f} s"
            if stretch != WHOLE and last_s > first_s
            else f"{path}: no motion: the times of its joints do not overlap; omit joints by --joint"
        )
    cut = {joint: one.between(begin_s, end_s) for joint, one in series.items()}
    _check_holes(path, cut, series, begin_s, end_s)
    times = np.unique(np.concatenate([[begin_s, end_s], *(one.time_s for one in cut.values())]))
    if len(times) * len(cut) > MOST_NUMBERS:
        raise InputError(
            f"{path}: {len(times)} rows of {len(cut)} joints are too many to play at once; choose a "
            "stretch by --from and --to"
        )
    position = np.stack([np.interp(times, one.time_s, one.position) for one in series.values()], axis=1)
    what = tuple(one.what for one in series.values())
    units = tuple(one.unit for one in series.values())
    return RecordedMotion(path, tuple(series), what, times - begin_s, position, begin_s, units)


def _check_holes(
    path: Path, cut: Mapping[str, Series], whole: Mapping[str, Series], begin_s: float, end_s: float
) -> None:
    holes = []
    for joint, one in cut.items():
        if whole[joint].continued:
            continue
        times = np.concatenate([[begin_s], one.time_s, [end_s]])
        width = np.diff(times)
        if width.max() > LONGEST_HOLE_S:
            at = int(width.argmax())
            holes.append(f"of {joint} from {times[at]:.3f} s to {times[at + 1]:.3f} s")
    if holes:
        raise InputError(
            f"{path}: the recording has no positions {', '.join(holes)}; choose a stretch without gaps by "
            "--from and --to"
        )
