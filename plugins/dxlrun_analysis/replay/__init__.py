"""Replay: the controllers of a log, run again on its inputs, and a comparison of their commands.

Playback of a recorded motion on a robot is not a replay; it belongs in `playback`.
"""

from dxlrun_analysis.replay.changes import Setting
from dxlrun_analysis.replay.comparison import JointDifferences
from dxlrun_analysis.replay.recorded import ReplayDifference
from dxlrun_analysis.replay.replay import ReplayReport, replay_log

__all__ = ["JointDifferences", "ReplayDifference", "ReplayReport", "Setting", "replay_log"]
