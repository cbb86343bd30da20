"""Logs: finding, reading and following the log files of runs.

`dxlrun.open_log` returns a `dxlrun.LogReader`, which reads a log slice by slice; `read_log` reads a whole log
at once. A damaged log is read as far as possible, and its damage is described.

    from dxlrun.tooling.logs import read_log

    log = read_log("run.mcap")
    print(len(log.cycles), "cycles,", len(log.packets), "packets", *log.damage)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.cli.tools.tool_log import TOOL_NAME as TOOL_NAME
    from dxlrun.log.columns import PacketColumns as PacketColumns
    from dxlrun.log.identity import IDENTITY_NAME as IDENTITY_NAME
    from dxlrun.log.identity import changed_code as changed_code
    from dxlrun.log.identity import runtime_hash as runtime_hash
    from dxlrun.log.log_reader import UNREADABLE as UNREADABLE
    from dxlrun.log.log_reader import LogFollower as LogFollower
    from dxlrun.log.log_reader import read_log as read_log
    from dxlrun.log.log_writer import TopicWriter as TopicWriter
    from dxlrun.log.parts import is_log_directory as is_log_directory
    from dxlrun.log.parts import log_files as log_files
    from dxlrun.log.reading.walk import LogWalk as LogWalk
    from dxlrun.log.schemas import FAILURES_NAME as FAILURES_NAME
    from dxlrun.log.schemas import SUMMARY_NAME as SUMMARY_NAME
    from dxlrun.log.schemas import LogSummary as LogSummary
    from dxlrun.log.stored import is_being_written as is_being_written
    from dxlrun.log.stored import oldest_beyond as oldest_beyond
    from dxlrun.log.stored import stored_logs as stored_logs
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
