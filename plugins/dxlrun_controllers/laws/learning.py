"""Iterative learning control: correction of a motion, learned from the errors of its repetitions.

u[k+1](t) = Q(u[k](t) + L e[k](t + delay)), where u is added to the commanded positions, e is desired minus
measured position, L the learning gain, and Q a zero-phase low-pass (D. A. Bristow, M. Tharayil,
A. G. Alleyne, "A survey of iterative learning control", IEEE Control Systems Magazine 26, 2006). For
position-controlled servos see M. Schwarz, S. Behnke, "Compliant Robot Behavior using Servo Actuator Models
identified by Iterative Learning Control", RoboCup 2013.

Q is a Gaussian. Its weights are not negative and their sum is 1, so Q(x) never exceeds the largest |x|.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats

Table = NDArray[np.float32]
"""Correction of a motion that is added to its positions, rad, shape (joints, rows), with one row per
cycle.
"""

MOST_DELAY_S: Final = 0.25
"""Longest tracking delay of a servo that is compensated, s."""
_TAPS: Final = 16384
"""Upper limit of the products of the filter's convolution in one step of learning, which take some 10 us."""
_LONGEST_STEP: Final = 256
_WIDTH: Final = 4.0
"""Half-width of the filter in standard deviations; the omitted tails have 0.006 % of the weight."""


def gaussian(cutoff_hz: float, period_s: float) -> Floats:
    """Return the weights of a zero-phase low-pass, shape (odd,). Its gain at the cut-off is 0.71 (-3 dB).

    A Gaussian with the standard deviation s has the gain exp(-(2 pi f s)^2 / 2).
    """
    deviation = math.sqrt(math.log(2.0)) / (2.0 * math.pi * cutoff_hz * period_s)
    side = np.arange(-math.ceil(_WIDTH * deviation), math.ceil(_WIDTH * deviation) + 1)
    weights: Floats = np.exp(-0.5 * (side / deviation) ** 2)
    weights /= weights.sum()
    return weights


class Repetition:
    """Record of one repetition of a motion, from which the next correction is computed in small steps.

    All memory is allocated by the constructor. `most_rows` is the length of the longest repetition, cycles.
    """

    def __init__(self, joints: int, most_rows: int, period_s: float, cutoff_hz: float) -> None:
        self._weights = gaussian(cutoff_hz, period_s)
        self._margin = math.ceil(MOST_DELAY_S / period_s) + 2
        self._period_s = period_s
        self._step = max(16, min(_LONGEST_STEP, _TAPS // len(self._weights)))
        self._applied = np.zeros((joints, most_rows))
        self._error = np.zeros((joints, most_rows + self._margin))
        self._raw = np.zeros(most_rows + len(self._weights))
        self._part = np.zeros(self._step)
        self._desired, self._squares = np.zeros((2, joints))
        self._slow = np.zeros((2, joints))
        """Sums of error times desired step, and of the step's square, by joint.

        Their quotient is the delay in rows.
        """
        self.most_rows = most_rows
        self.rows = 0
        """Number of rows that were recorded in this repetition."""

    def start_recording(self) -> None:
        """Start the record of a new repetition."""
        self.rows = 0
        self._squares.fill(0.0)
        self._slow.fill(0.0)

    def record(self, desired: Floats, measured: Floats, applied: Floats, judged: bool) -> None:
        """Append the positions and the applied correction of a cycle, rad, shape (joints,).

        Only `judged` rows count towards `error` and `delay_s`.
        """
        row, error = self.rows, desired - measured
        self._error[:, row] = error
        self._applied[:, row] = applied
        if judged:
            self._squares += error * error
            if row:
                way = desired - self._desired
                self._slow[0] += way * error
                self._slow[1] += way * way
        np.copyto(self._desired, desired)
        self.rows = row + 1

    def error(self, judged_rows: int) -> float:
        """Return the root mean square position error over all joints and the judged rows, rad."""
        return math.sqrt(float(self._squares.sum()) / (judged_rows * len(self._squares)))

    def delay_s(self) -> Floats:
        """Return the tracking delay T of each joint, s, estimated from its errors, 0 to MOST_DELAY_S.

        With q(t) = d(t - T), the error is about T d'(t).
        """
        slow, fast = self._slow
        delay = np.divide(slow, fast, out=np.zeros_like(slow), where=fast > 0) * self._period_s
        return np.asarray(np.clip(delay, 0.0, MOST_DELAY_S), np.float64)

    def learn_correction(
        self, old: Table | None, new: Table, gain: float, delay_s: Floats, most: Floats
    ) -> Iterator[None]:
        """Compute the next correction from this repetition, and yield after each small step.

        Args:
            old: Correction that was applied, used for rows that were not recorded; None if there was none.
            new: Output, shape (joints, rows).
            gain: Learning gain, 0..1.
            delay_s: Delay of each joint, s, shape (joints,).
            most: Largest correction of each joint, rad, shape (joints,).
        """
        rows, width = new.shape[1], len(self._weights)
        half, recorded = width // 2, min(self.rows, rows)
        raw = self._raw[: rows + width - 1]
        for joint in range(len(new)):
            error, shift = self._error[joint], float(delay_s[joint]) / self._period_s
            error[self.rows : self.rows + self._margin] = 0.0
            whole = min(int(shift), self._margin - 2)
            share = shift - whole
            self._applied[joint, recorded:rows] = 0.0 if old is None else old[joint, recorded:rows]
            for first in range(0, rows, _LONGEST_STEP):
                end = min(first + _LONGEST_STEP, rows)
                later = slice(first + whole, end + whole)
                latest = slice(first + whole + 1, end + whole + 1)
                raw[half + first : half + end] = self._applied[joint, first:end] + gain * (
                    (1.0 - share) * error[later] + share * error[latest]
                )
                yield
            raw[:half] = raw[half]
            raw[half + rows :] = raw[half + rows - 1]
            for first in range(0, rows, self._step):
                end = min(first + self._step, rows)
                smooth = np.convolve(raw[first : end + width - 1], self._weights, mode="valid")
                new[joint, first:end] = np.clip(smooth, -most[joint], most[joint])
                yield
