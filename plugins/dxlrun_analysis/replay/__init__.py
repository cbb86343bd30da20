"""Replay: run the controllers of a log again on its recorded inputs, and compare their commands with the log.

Playback of a recorded motion on a robot is not a replay; it belongs in `playback`.
"""

from dxlrun_analysis.replay.changes import Setting
from dxlrun_analysis.replay.comparison import JointDifferences
from dxlrun_analysis.replay.log_replay import ReplayReport, replay_log
from dxlrun_analysis.replay.recorded_inputs import ReplayDifference

__all__ = ["JointDifferences", "ReplayDifference", "ReplayReport", "Setting", "replay_log"]
