"""Replay: the controllers of a log run again on what they were given then, and must want the same."""

from dxlrun.log.replay.comparison import Difference, JointDifferences
from dxlrun.log.replay.replay import ReplayReport, replay_log

__all__ = ["Difference", "JointDifferences", "ReplayReport", "replay_log"]
