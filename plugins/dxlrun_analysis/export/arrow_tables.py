"""Arrow tables of a log: one row per cycle, packet, event, command or message, made slice by slice.

Column names have the units; unknown values and interfaces without a command are null. Every table has
`time_s`, s since the log's first record, and `t_ns`, ns of the run's clock. Wall time is `t_ns` +
`epoch_offset_ns`, which is in the metadata of the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from dxlrun import Log, LogError, LogReader
from dxlrun.tooling.records import SOURCE_COMMAND, Severity, Torque
from dxlrun.tooling.topics import Codec, LoggedTopic, LogTopic, bus_topic, message_struct
from dxlwire import Mode, PacketKind

CYCLES, EVENTS, COMMANDS = LogTopic.CYCLE, LogTopic.EVENT, LogTopic.COMMANDS
PACKETS = "/packets"  # Packets of all buses; `/bus/NAME` has those of one bus
WITHOUT_TABLE: Mapping[str, str] = {
    LogTopic.JOINT_STATES: "the states are in /cycle",
    LogTopic.JOINT_COMMANDS: "the goals are in /cycle",
    LogTopic.DIAGNOSTICS: "temperatures, voltages, hardware errors and modes are in /cycle",
    LogTopic.FRAMES: "the URDF and the positions in /cycle give the frames",
    LogTopic.STILL_FRAMES: "the URDF has these frames",
    LogTopic.ROBOT_DESCRIPTION: "its only message is the URDF",
    LogTopic.ROSOUT: "the same events are in /events",
    LogTopic.ACTIVATION: "its only message has the states and goals before the first cycle",
}
"""Topics of a log that are not exported as a table, and the reason for each."""
_ROWS = 4096
"""Number of cycles in an Arrow table. A slice of the log can have only a few cycles, and each table costs
some time per column."""

_JOINT_COLUMNS: tuple[tuple[str, str], ...] = (
    ("position", "position_rad"),
    ("velocity", "velocity_rad_s"),
    ("effort", "effort"),
    ("valid", "valid"),
    ("age_ns", "age_ms"),
    ("command_position", "command_position_rad"),
    ("command_velocity", "command_velocity_rad_s"),
    ("command_effort", "command_effort"),
    ("command_pwm", "command_pwm"),
    ("goal_position", "goal_position_rad"),
    ("goal_velocity", "goal_velocity_rad_s"),
    ("goal_effort", "goal_effort"),
    ("goal_pwm", "goal_pwm"),
    ("clamped", "clamped"),
    ("temperature", "temperature_deg_c"),
    ("voltage", "voltage_v"),
    ("hardware_error", "hardware_error"),
    ("mode", "mode"),
    ("torque", "torque"),
)
"""Fields of a cycle with one element per joint, and their column names after `JOINT/`."""
_MODES = [mode.name.lower() for mode in Mode]
_TORQUES = [torque.name.lower() for torque in Torque]
_KINDS = ["", *(kind.name.lower() for kind in PacketKind)]


class TableRows(msgspec.Struct, frozen=True, eq=False):
    """Some consecutive rows of one exported table."""

    name: str  # Topic: `/cycle`, `/packets`, `/bus/NAME`, `/events`, `/commands`, or one of a controller
    table: pa.Table


def topics_without_table(reader: LogReader, has_table: Callable[[str], bool]) -> dict[str, str]:
    """Return the topics of a log that have no table, and the reason for each.

    Args:
        reader: The log.
        has_table: Predicate that is true if the table of a topic was written.
    """
    return {
        name: WITHOUT_TABLE.get(name, "the log has no message of this topic")
        for name in sorted(reader.topics)
        if name in WITHOUT_TABLE or not has_table(name)
    }


def tables_of(slices: Iterable[Log], only: Container[str] | None = None) -> Iterator[TableRows]:
    """Yield the tables of a log, slice by slice, in memory that does not grow with the log.

    Args:
        slices: Slices of the log.
        only: Topics to yield; without it, all topics but `/bus/NAME`.

    Raises:
        LogError: A record cannot be read.
    """
    begin_ns: int | None = None
    waiting: list[NDArray[np.void]] = []
    last: Log | None = None
    for log in slices:
        last, begin_ns = log, _first_ns(log) if begin_ns is None else begin_ns
        since_ns = begin_ns or 0
        if len(log.cycles) and (only is None or CYCLES in only):
            waiting.append(log.cycles)
            if sum(map(len, waiting)) >= _ROWS:
                yield TableRows(CYCLES, _cycle_table(log, waiting, since_ns))
                waiting = []
        if log.events and (only is None or EVENTS in only):
            yield TableRows(EVENTS, _events(log, since_ns))
        if log.commands and (only is None or COMMANDS in only):
            yield TableRows(COMMANDS, _commands(log, since_ns))
        for topic in log.topics.values():
            if topic.data and (only is None or topic.name in only):
                yield TableRows(topic.name, _messages(log, topic, since_ns))
        yield from _packets(log, since_ns, only)
    if waiting and last is not None:
        yield TableRows(CYCLES, _cycle_table(last, waiting, begin_ns or 0))


def _first_ns(log: Log) -> int | None:
    """Return the time of the first record, ns of the run's clock: the zero of `time_s`."""
    times = [*(event.t_ns for event in log.events[:1]), *log.cycles["scheduled_ns"][:1].tolist()]
    return min(times, default=None)


def _packets(log: Log, begin_ns: int, only: Container[str] | None) -> Iterator[TableRows]:
    asked = only is None or PACKETS in only
    buses = [number for number, bus in enumerate(log.buses) if only is not None and bus_topic(bus) in only]
    if not (asked or buses) or not len(log.packets):
        return
    table = _packet_table(log, begin_ns)
    if asked:
        yield TableRows(PACKETS, table)
    for index in buses:
        rows = np.flatnonzero(log.packets.bus == index)
        if len(rows):
            yield TableRows(bus_topic(log.buses[index]), table.take(pa.array(rows)))


def _cycle_table(log: Log, parts: Sequence[NDArray[np.void]], begin_ns: int) -> pa.Table:
    """Convert cycles to an Arrow table.

    The columns are the times of each cycle, controllers, joints, references, the states of devices, sensors
    and controllers, and the commands of devices.
    """
    cycles = np.concatenate(parts)
    columns = _cycle_times(cycles, begin_ns)
    for index, controller in enumerate(log.controllers):
        active = (cycles["active"] >> np.uint64(index)) & np.uint64(1)
        columns[f"{controller.name}/active"] = pa.array(active.astype(bool))
        columns[f"{controller.name}/update_us"] = _micro(cycles["controller_ns"][:, index])
    for row, joint in enumerate(log.joints):
        for field, name in _JOINT_COLUMNS:
            columns[f"{joint}/{name}"] = _joint_column(field, cycles[field][:, row])
    for row, reference in enumerate(log.header.references):
        columns[reference] = _known(cycles["reference"][:, row])
    layout = log.header.layout
    for row, source in enumerate(layout.sources):
        columns[f"{source}/valid"] = pa.array(np.ascontiguousarray(cycles["source_valid"][:, row]))
        columns[f"{source}/age_ms"] = _joint_column("age_ns", cycles["source_age_ns"][:, row])
    for row, state in enumerate(layout.source_states):
        columns[state] = _known(cycles["source_state"][:, row])
    for row, command in enumerate(layout.source_commands):
        device, _, name = command.partition("/")
        columns[f"{device}/command.{name}"] = _known(cycles[SOURCE_COMMAND][:, row])
    return _table(log, columns)


def _cycle_times(cycles: NDArray[np.void], begin_ns: int) -> dict[str, pa.Array]:
    """Return the columns of cycles that belong to no joint or controller: numbers, times, durations."""
    return {
        "cycle": pa.array(cycles["cycle"]),
        **_times(cycles["scheduled_ns"], begin_ns),
        "late_us": _micro(cycles["woken_ns"] - cycles["scheduled_ns"]),
        "read_us": _micro(cycles["read_ns"] - cycles["woken_ns"]),
        "update_us": _micro(cycles["updated_ns"] - cycles["read_ns"]),
        "write_us": _micro(cycles["written_ns"] - cycles["updated_ns"]),
        "period_ms": pa.array(cycles["period_ns"] / 1e6),
        "skipped": pa.array(cycles["skipped"]),
        "commands": pa.array(cycles["command_count"]),
    }


def _joint_column(field: str, values: NDArray[np.generic]) -> pa.Array:
    if field == "age_ns":
        ages = values.astype(np.float64) / 1e6
        return pa.array(ages, mask=ages < 0)  # -1 ns means that no reply ever came
    if field in ("mode", "torque"):
        return _words(values, _MODES if field == "mode" else _TORQUES)
    return _known(values) if values.dtype.kind == "f" else pa.array(np.ascontiguousarray(values))


def _packet_table(log: Log, begin_ns: int) -> pa.Table:
    packets = log.packets
    # `data` can also have bytes of packets outside the selection, so gather those of each packet.
    ends = np.cumsum(packets.length)
    place = np.repeat(packets.start - (ends - packets.length), packets.length) + np.arange(
        int(ends[-1]) if len(ends) else 0
    )
    offsets = np.concatenate(([0], ends)).astype(np.int32)
    data = pa.Array.from_buffers(
        pa.binary(), len(packets), [None, pa.py_buffer(offsets), pa.py_buffer(packets.data[place].tobytes())]
    )
    return _table(
        log,
        {
            **_times(packets.first_ns, begin_ns),
            "lasted_us": _micro(packets.last_ns - packets.first_ns),
            "cycle": pa.array(packets.cycle, mask=packets.cycle < 0),
            "bus": _words(packets.bus, list(log.buses)),
            "kind": _words(packets.kind, _KINDS),
            "servo_id": pa.array(packets.servo_id),
            "data": data,
        },
    )


def _events(log: Log, begin_ns: int) -> pa.Table:
    events = log.events
    severities = {int(severity): severity.name.lower() for severity in Severity}
    return _table(
        log,
        {
            **_times(np.array([event.t_ns for event in events], np.int64), begin_ns),
            "code": pa.array([event.code for event in events], pa.int32()),
            "name": pa.array([event.name for event in events]),
            "severity": pa.array([severities.get(event.severity, str(event.severity)) for event in events]),
            "source": pa.array([event.source for event in events]),
            "text": pa.array([event.text for event in events]),
            "data": pa.array([event.data.decode(errors="replace") or None for event in events], pa.string()),
        },
    )


def _commands(log: Log, begin_ns: int) -> pa.Table:
    commands = log.commands
    leases = np.array([command.lease_ns for command in commands], np.int64)
    return _table(
        log,
        {
            **_times(np.array([command.t_ns for command in commands], np.int64), begin_ns),
            "cycle": pa.array([command.cycle for command in commands], pa.int64()),
            "controller": pa.array([command.controller or "loop" for command in commands]),
            "kind": pa.array([command.kind for command in commands]),
            "origin": pa.array([command.origin for command in commands]),
            "planned": pa.array([None if c.planned < 0 else c.planned for c in commands], pa.int64()),
            "lease_s": pa.array(leases / 1e9, mask=leases == 0),
            "data": pa.array([command.data for command in commands], pa.binary()),
        },
    )


def _messages(log: Log, topic: LoggedTopic, begin_ns: int) -> pa.Table:
    """Convert the messages of a topic to an Arrow table with a column for each field; fields of nested
    messages are named `a.b`."""
    try:
        codec = Codec(topic.type)
        values = [codec.unpack(data) for data in topic.data]
    except ValueError as error:
        raise LogError(f"{log.path}: a message of {topic.name} cannot be read: {error}") from error
    whole = pa.array(values, message_struct(topic.type))
    columns = dict(_times(topic.t_ns, begin_ns))
    for name, column in _flat("", whole):
        columns[f"{name}_" if name in columns else name] = column
    return _table(log, columns)


def _flat(place: str, column: pa.StructArray) -> Iterator[tuple[str, pa.Array]]:
    for field, values in zip(column.type, column.flatten(), strict=True):
        name = f"{place}{field.name}"
        if pa.types.is_struct(field.type):
            yield from _flat(f"{name}.", values)
        else:
            yield name, values


def _times(t_ns: NDArray[np.int64], begin_ns: int) -> Mapping[str, pa.Array]:
    return {"time_s": pa.array((t_ns - begin_ns) / 1e9), "t_ns": pa.array(t_ns)}


def _micro(values: NDArray[np.int64]) -> pa.Array:
    return pa.array(values / 1e3)


def _known(values: NDArray[np.generic]) -> pa.Array:
    return pa.array(np.ascontiguousarray(values), from_pandas=True)  # NaN becomes null


def _words(values: NDArray[np.generic], words: list[str]) -> pa.Array:
    indices = pa.array(values.astype(np.int8))
    return pa.DictionaryArray.from_arrays(indices, pa.array(words, pa.string()))


def _table(log: Log, columns: Mapping[str, pa.Array]) -> pa.Table:
    about = {"robot": log.header.robot, "epoch_offset_ns": str(log.header.epoch_offset_ns)}
    return pa.table(dict(columns)).replace_schema_metadata(about)
