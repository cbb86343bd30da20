"""A whole controller: `type: ./wave.py:Wave` in wave.yaml."""

import numpy as np

from dxlrun import Angle, Floats, Frequency, JointController


class Wave(JointController):
    """Moves its joints along a sine."""

    amplitude: Angle = 0.3
    frequency: Frequency = 0.5

    def positions(self, time: float, dt: float) -> Floats:
        """Return where each joint is to be, `time` s after the controller began."""
        return self.start + self.amplitude * np.sin(2 * np.pi * self.frequency * time)
