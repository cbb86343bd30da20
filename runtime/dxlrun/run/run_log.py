"""Run log: creates the file and the header of a new run's log."""

from __future__ import annotations

import platform
import sys
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import mcap
import msgspec
import numpy as np
import pluggy
import pydantic
from msgspec.structs import replace

from dxlrun.channels.kept import KeptStates
from dxlrun.contract.hookspecs import CONTRACT_VERSION
from dxlrun.errors import InputError
from dxlrun.log.identity import IDENTITY_NAME, INCLUDED, MOTION, ROBOT, URDF, file_key, identity
from dxlrun.log.log_file import FOLDER_MODE, LOG_MODE
from dxlrun.log.schemas import KEPT_ATTACHMENT, LogHeader
from dxlrun.plan.recording_plan import PART_PATTERN, RecordingPlan
from dxlrun.plan.robot_plan import Plan, to_json
from dxlwire.port.latency_timer import is_simulated

_LIBRARIES = (mcap, msgspec, np, pluggy, pydantic)
"""Libraries whose versions are in the log. The metadata of their packages would take long to parse."""


def log_header(
    plan: Plan, epoch_offset_ns: int, *, virtual: bool, kept: KeptStates | None = None
) -> LogHeader:
    """Return the header of a run's log, with robot files and versions that make it self-contained.

    `epoch_offset_ns` is wall time minus the run's clock; `kept` are the states that controllers begin with.
    """
    scheduler = plan.loop.scheduler
    machine = platform.uname()
    return replace(
        LogHeader.from_plan(plan, epoch_offset_ns),
        attachments={
            "robot.yaml": plan.source_text.encode(),
            "plan.json": to_json(plan),
            KEPT_ATTACHMENT: msgspec.json.encode(kept or KeptStates()),
            **{f"included/{name}": text.encode() for name, text in plan.included.items()},
            **{f"motion/{name}": text.encode() for name, text in plan.played.items()},
        },
        metadata={
            "run": {
                "robot_file": plan.source_file,
                "clock": "virtual" if virtual else "monotonic",
                "epoch_offset_ns": str(epoch_offset_ns),
                "simulated": " ".join(bus.name for bus in plan.buses if virtual or is_simulated(bus.port)),
                **{f"argument {name}": value for name, value in plan.arguments.items()},
            },
            IDENTITY_NAME: identity(plan.source_file, _files(plan), plan.packages),
            "versions": {
                "python": sys.version.split()[0],
                "contract": str(CONTRACT_VERSION),
                "dxlrun": version("dxlrun"),
                **{library.__name__: library.__version__ for library in _LIBRARIES},
            },
            "plugins": {controller.type: controller.distribution for controller in plan.loop.controllers},
            "kernel": {"system": machine.system, "release": machine.release, "version": machine.version}
            | {"machine": machine.machine},
            "scheduler": {
                "policy": scheduler.policy,
                "priority": str(scheduler.priority),
                "lock_memory": str(scheduler.lock_memory).lower(),
                "cores": ", ".join(map(str, scheduler.cores)),
                "polling": "auto" if scheduler.polling_ns is None else f"{scheduler.polling_ns} ns",
                "reply_polling": "auto"
                if scheduler.reply_polling_ns is None
                else f"{scheduler.reply_polling_ns} ns",
                "idle_latency": str(scheduler.idle_latency).lower(),
                "overrun": plan.loop.overrun,
            },
        },
    )


def _files(plan: Plan) -> dict[str, str]:
    """Return the texts of all files from which a plan was compiled, by their keys in the run's identity."""
    return {
        file_key(ROBOT, Path(plan.source_file).name): plan.source_text,
        **{file_key(INCLUDED, name): text for name, text in plan.included.items()},
        **{file_key(MOTION, name): text for name, text in plan.played.items()},
        **({} if plan.urdf is None else {URDF: plan.urdf}),
    }


def new_log(recording: RecordingPlan, robot: str) -> Path:
    """Create an empty file for a log, `<robot>_<date>_<time>.mcap`, and return its path.

    A log in parts gets a directory, `<robot>_<date>_<time>`. Creating the file reserves the name, so two runs
    that start in the same second have different names. A directory of `~/logs` is in the user's home. Raises
    InputError when the file or directory cannot be created.
    """
    directory, suffix = Path(recording.directory), "" if recording.in_parts else ".mcap"
    try:
        directory = directory.expanduser()
        directory.mkdir(parents=True, exist_ok=True)
    except RuntimeError as error:
        raise InputError(f"the log's directory {directory}: {error}; write its absolute path") from error
    except OSError as error:
        raise InputError(
            f"the log's directory {directory} cannot be made: {error.strerror or error}; write another under "
            "`recording: {directory: ...}` or give --no-record"
        ) from error
    stem, number = f"{robot}_{time.strftime('%Y%m%d_%H%M%S')}", 1
    while True:
        path = directory / f"{stem}{f'_{number}' * (number > 1)}{suffix}"
        try:
            if recording.in_parts:
                path.mkdir(FOLDER_MODE)
            else:
                path.touch(LOG_MODE, exist_ok=False)
        except FileExistsError:
            number += 1
        except OSError as error:
            raise InputError(
                f"no log can be written in {directory}: {error.strerror or error}; write another directory "
                "under `recording: {directory: ...}` or give --no-record"
            ) from error
        else:
            return path


def discard_log(log: Path) -> None:
    """Delete the log, a file or a directory of parts, of a run that sent nothing to the robot."""
    if log.is_dir():
        for part in log.glob(PART_PATTERN):
            part.unlink(missing_ok=True)
        # Another program may have put a file there.
        with suppress(OSError):
            log.rmdir()
    else:
        log.unlink(missing_ok=True)


def incomplete_log(error: str) -> str:
    """Return the sentence for the user about a log that is incomplete because of an error."""
    return f"the log is incomplete: {error}"
