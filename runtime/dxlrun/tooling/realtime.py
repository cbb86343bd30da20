"""Real time: settings that the operating system grants a process, and deadlines like those of a run's loop.

This example prints how late the machine wakes a process. `apply_scheduler` would first give the process the
settings of a loop:

    from dxlrun.tooling.realtime import Deadlines

    deadline_ns, woken_ns = Deadlines(period_ns=1_000_000).wait_for_deadline()
    print(woken_ns - deadline_ns, "ns late")
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.channels.child_processes import start_module as start_module
    from dxlrun.channels.shared_memory import load as load
    from dxlrun.channels.shared_memory import store as store
    from dxlrun.control.deadlines import Deadlines as Deadlines
    from dxlrun.control.realtime_grants import Grant as Grant
    from dxlrun.control.realtime_grants import apply_scheduler as apply_scheduler
    from dxlrun.control.realtime_grants import keep_awake as keep_awake
    from dxlrun.control.realtime_grants import lock_memory as lock_memory
    from dxlrun.control.realtime_grants import may_lock as may_lock
    from dxlrun.control.realtime_grants import missing_priority as missing_priority
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
