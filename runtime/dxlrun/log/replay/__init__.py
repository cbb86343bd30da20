"""Replay: the controllers of a log run again on the inputs in it, and must command the same."""

from dxlrun.log.replay.changes import Setting
from dxlrun.log.replay.comparison import JointDifferences, ReplayDifference
from dxlrun.log.replay.replay import ReplayedPart, ReplayReport, replay_log

__all__ = ["JointDifferences", "ReplayDifference", "ReplayReport", "ReplayedPart", "Setting", "replay_log"]
