"""Source process: a process of a feature that opens a source and writes its samples into the loop's slot.

It is newly executed, in its own session, and ends by SIGTERM or with the supervisor.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import NoReturn

import msgspec
import numpy as np

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import Failed, MessageChannel, Ready
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotReader, SlotState, SlotWriter
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.control.sampled_sources import (
    ProcessStage,
    SampledSource,
    SourceContext,
    SourceProcess,
    describe_error,
)
from dxlrun.errors import PlugInError
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlsim.motion.body import SimulatedBody
from dxlsim.motion.link_motion import LinkMotion, Shafts
from dxlsim.simulation_plan import UrdfBodies

END_S = 1.0
"""Time that a source gets to close its device at the end, s."""
_SHORTEST_NAP_S = 0.001
"""Shortest sleep between samples: a device whose read fails to block must not use a whole core."""


@dataclass(frozen=True, slots=True)
class SourceJob:
    """Arguments of a process that samples a source, such as a sensor."""

    feature: Feature
    process: SourceProcess
    slot: int
    """File descriptor of the shared memory for samples."""
    supervisor: int
    """Process ID of the supervisor, whose exit ends this process."""
    restarted: bool = False
    """True for a restarted process, which continues even when its device cannot be opened."""
    bodies: UrdfBodies | None = None
    """Bodies that the simulated servos move; for sources that measure a simulated robot."""
    shafts: int = -1
    """File descriptor of the slot with the state of the simulated shafts."""


class RemoteBody:
    """Body of a simulation in another process, computed from the state of its shafts in a slot."""

    def __init__(self, bodies: UrdfBodies, reader: SlotReader) -> None:
        self._body = SimulatedBody(bodies)
        self._reader = reader
        self.now_ns = time.monotonic_ns
        count = bodies.servos
        self._shafts = Shafts(0, *(np.zeros(count) for _ in range(3)))

    def motion(self, link: str) -> LinkMotion:
        """Return the present motion of a link. Raises KeyError for a link that the URDF does not have."""
        t_ns = self._reader.read_sample()
        if t_ns is not None:
            angle, velocity, acceleration = self._reader.sample.copy().reshape(3, -1)
            self._shafts = Shafts(t_ns, angle, velocity, acceleration)
        shafts = self._shafts
        ahead_s = max(0, self.now_ns() - shafts.t_ns) * 1e-9
        now = Shafts(
            shafts.t_ns, shafts.angle + shafts.velocity * ahead_s, shafts.velocity, shafts.acceleration
        )
        self._body.set_shafts(now)
        return self._body.motion(link)


class _Stop(BaseException):
    """Raised by the handler of SIGTERM. Not an Exception, so handlers of driver errors do not catch it."""


def _stop(*_: object) -> None:
    # Without a supervisor, nothing else ends a driver that does not close: the uncaught SIGALRM kills the
    # process.
    signal.setitimer(signal.ITIMER_REAL, END_S)
    raise _Stop


def main() -> int:
    """Run the process of a source: `--job-fd N --kind KIND --control-fd M`."""
    job, channel = child_processes.begun(SourceJob, msgspec.json.Decoder(msgspec.Struct))
    signal.signal(signal.SIGTERM, _stop)
    child_processes.hold_foreign_code(signal.SIGTERM)
    if os.getppid() != job.supervisor:
        # The supervisor exited before its death could be signalled.
        return 1
    try:
        with suppress(_Stop):
            return _run(job, channel)
        return 0
    finally:
        if os.getppid() != job.supervisor:
            # Nothing else ends the processes that the driver has started.
            os.killpg(0, signal.SIGKILL)


def _run(job: SourceJob, channel: MessageChannel[msgspec.Struct]) -> int:
    process, writer = job.process, SlotWriter(mapped(job.slot))
    body = None
    if job.bodies is not None:
        body = RemoteBody(job.bodies, SlotReader(mapped(job.shafts)))
    ((_, stage),) = stages(ProcessStage, [job.feature])
    try:
        sampled = stage.build(process.plan, SourceContext(load_plugins(), writer, time.monotonic_ns, body))
    except PlugInError as error:
        channel.send_message(Failed(str(error)))
        return 1
    try:
        sampled.open_first()
    except _Stop:
        raise
    # Any error of a driver becomes a sentence.
    except Exception as error:
        if not job.restarted:
            channel.send_message(Failed(f"{process.title} cannot be opened: {describe_error(error)}"))
            return 1
        sampled.close_after_error(error)
    try:
        channel.send_message(Ready())
        _sample_for_ever(sampled, process.period_ns)
    finally:
        # The process is already stopping.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        sampled.close()
        writer.write_state(SlotState.ENDED, "")


def _sample_for_ever(sampled: SampledSource, period_ns: int) -> NoReturn:
    due_ns = time.monotonic_ns()
    while True:
        came = sampled.sample()
        now_ns = time.monotonic_ns()
        if not sampled.is_open:
            time.sleep(max(_SHORTEST_NAP_S, (sampled.reopen_ns - now_ns) * 1e-9))
        elif sampled.driver.waits:
            if not came:
                time.sleep(_SHORTEST_NAP_S)
        else:
            due_ns = max(due_ns + period_ns, now_ns - period_ns)
            if due_ns > now_ns:
                time.sleep((due_ns - now_ns) * 1e-9)


if __name__ == "__main__":
    sys.exit(main())
