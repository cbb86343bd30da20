"""What a log says about its run before the first cycle: files, versions, kernel, wishes."""

from __future__ import annotations

import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path

from dxlrun.compile.plan import Plan, to_json
from dxlrun.control.controller import CONTRACT_VERSION
from dxlrun.errors import InputError
from dxlrun.recording.header import LoggedController, LogHeader

_LIBRARIES = ("dxlrun", "mcap", "msgspec", "numpy", "pluggy", "pydantic", "pyserial")


def log_header(plan: Plan, epoch_offset_ns: int, *, virtual: bool) -> LogHeader:
    """Return everything that makes the log explain itself.

    `epoch_offset_ns` is added to the run's clock to get wall time.
    """
    scheduler = plan.loop.scheduler
    machine = platform.uname()
    return LogHeader(
        robot=plan.robot,
        joints=tuple(joint.name for joint in plan.loop.joints),
        buses=tuple(bus.name for bus in plan.buses),
        controllers=tuple(
            LoggedController(controller.name, controller.joints, controller.publishes)
            for controller in plan.loop.controllers
        ),
        period_ns=plan.loop.period_ns,
        epoch_offset_ns=epoch_offset_ns,
        attachments={
            "robot.yaml": plan.source_text.encode(),
            "plan.json": to_json(plan),
            **{f"included/{name}": text.encode() for name, text in plan.included.items()},
        },
        robot_description=plan.urdf,
        metadata={
            "run": {
                "robot_file": plan.source_file,
                "clock": "virtual" if virtual else "monotonic",
                "epoch_offset_ns": str(epoch_offset_ns),
                **{f"argument {name}": value for name, value in plan.arguments.items()},
            },
            "versions": {"python": sys.version.split()[0], "contract": str(CONTRACT_VERSION)}
            | {name: version(name) for name in _LIBRARIES},
            "plugins": {controller.type: controller.distribution for controller in plan.loop.controllers},
            "kernel": {"system": machine.system, "release": machine.release, "version": machine.version}
            | {"machine": machine.machine},
            "scheduler": {
                "policy": scheduler.policy,
                "priority": str(scheduler.priority),
                "lock_memory": str(scheduler.lock_memory).lower(),
            },
        },
    )


def epoch_offset_ns() -> int:
    """Return wall time minus monotonic time, ns: read once, so that a clock step cannot bend the log."""
    return time.time_ns() - time.monotonic_ns()


def new_log(directory: Path, robot: str) -> Path:
    """Return the path of a log that does not exist yet: `<robot>_<date>_<time>.mcap`.

    Raises InputError when there is no such directory and none can be made.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the log's directory {directory} cannot be made: {error.strerror or error}; write another under "
            "`recording: {directory: ...}` or give --no-record"
        ) from error
    stem = f"{robot}_{time.strftime('%Y%m%d_%H%M%S')}"
    path = directory / f"{stem}.mcap"
    number = 2
    while path.exists():
        path = directory / f"{stem}_{number}.mcap"
        number += 1
    return path
