"""Sweep: one motion of a robot at many values of its robot file, on virtual time, each run scored."""

from typing import Literal

By = Literal["rms", "worst", "overshoot", "settling", "energy", "temperature"]
"""Scores by which runs are ordered."""
PICTURE_MARK = "dxlrun sweep"
"""In the metadata of each picture; only such a file is replaced by a new picture."""
