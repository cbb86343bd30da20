"""Replay: the controllers of a log run again on what they were given then, and must want the same."""

from dxlrun.replay.comparison import Difference, JointDifferences
from dxlrun.replay.replay import ReplayReport, replay_log, to_json

__all__ = ["Difference", "JointDifferences", "ReplayReport", "replay_log", "to_json"]
