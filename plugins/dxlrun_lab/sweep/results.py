"""Results: the rows of a sweep in a Parquet file, whole at every moment, and what they were measured from."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, get_args

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec.structs import asdict, fields

from dxlrun.errors import InputError, LogError
from dxlrun.output.target import check_target, make_folder_of, new_target
from dxlrun_lab.sweep.measuring import Measured
from dxlrun_lab.sweep.ranges import Value
from dxlrun_lab.sweep.scores import Scores

_KEY = b"dxlrun.sweep"
_PARQUET = "PAR1"  # magic number of the format; `read_results` judges the rest
_RUN, _STATUS, _REASON = "run", "status", "reason"


class ParameterColumn(msgspec.Struct, frozen=True):
    """One parameter: its place in the robot file, and the unit of its values."""

    place: str
    unit: str
    kind: Literal["number", "word"]
    """Numbers are held without their unit."""


class SweepHeader(msgspec.Struct, frozen=True):
    """What a sweep is of; two with the same may share a file."""

    robot: str
    robot_file: str
    """SHA-256 of the robot file and all that it includes or names: motors, URDF"""
    motions: tuple[str, ...]
    """SHA-256 of each motion file"""
    arguments: dict[str, str]
    """As given"""
    parameters: tuple[ParameterColumn, ...]
    versions: dict[str, str]
    command: str
    """The command line that wrote the file last"""


class Row(msgspec.Struct, frozen=True):
    """One run."""

    run: str
    """Hash of all that the run depends on"""
    values: tuple[Value, ...]
    """Of the parameters; numbers without their unit"""
    measured: Measured


def digest(*parts: bytes) -> str:
    """Return a SHA-256, in hexadecimal, of some bytes."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(len(part).to_bytes(8, "little") + part)
    return whole.hexdigest()


def difference(header: SweepHeader, other: SweepHeader) -> str:
    """Return in what two sweeps differ so that they cannot share a file; empty where they can."""
    pairs = {
        f"another robot file ({other.robot})": (header.robot_file, other.robot_file),
        "another motion": (header.motions, other.motions),
        "other arguments": (header.arguments, other.arguments),
        f"other parameters ({', '.join(column.place for column in other.parameters)})": (
            header.parameters,
            other.parameters,
        ),
        f"other versions ({', '.join(f'{name} {version}' for name, version in other.versions.items())})": (
            header.versions,
            other.versions,
        ),
    }
    return next((what for what, (mine, found) in pairs.items() if mine != found), "")


def read_results(path: Path) -> tuple[SweepHeader, tuple[Row, ...]]:
    """Return what a file holds; raises LogError when it is no sweep."""
    try:
        table = pq.read_table(path)
        header = msgspec.json.decode((table.schema.metadata or {}).get(_KEY, b""), type=SweepHeader)
        rows = [_row(header, values) for values in table.to_pylist()]
    except (OSError, pa.ArrowException, msgspec.DecodeError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise LogError(f"{path} is no file of a sweep ({reason}); choose another --output") from None
    return header, tuple(rows)


def check_output(path: Path) -> None:
    """Make the folder of a file; raises InputError where it cannot be written."""
    make_folder_of(path)
    check_target(path, _PARQUET)


@contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Keep other sweeps from a file meanwhile; raises InputError where one is at it."""
    lock = path.with_name(f".{path.name}.lock")
    with lock.open("a") as file:  # nothing is cut, should the name be a link of another user
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"another sweep writes --output {path}; wait for its end, or choose another"
            ) from None
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def write_results(path: Path, header: SweepHeader, rows: Iterable[Row]) -> None:
    """Write a file in place of the one before: a reader finds either of them, whole, at every moment.

    Raises InputError where that fails.
    """
    schema = _schema(header)
    columns: dict[str, list[object]] = {name: [] for name in schema.names}
    names = [column.place for column in header.parameters]
    for row in rows:
        scores = asdict(row.measured.scores) if row.measured.scores is not None else {}
        flat = {
            _RUN: row.run,
            **dict(zip(names, row.values, strict=True)),
            _STATUS: row.measured.status,
            _REASON: row.measured.reason,
            **scores,
        }
        for name, values in columns.items():
            values.append(flat.get(name))
    with new_target(path, _PARQUET) as beside, beside.open("wb") as file:
        pq.write_table(pa.Table.from_pydict(columns, schema=schema), file)
        file.flush()
        os.fsync(file.fileno())


def _schema(header: SweepHeader) -> pa.Schema:
    parameters = [
        pa.field(
            column.place,
            pa.float64() if column.kind == "number" else pa.string(),
            metadata={"unit": column.unit} if column.unit else None,
        )
        for column in header.parameters
    ]
    scores = [pa.field(field.name, _arrow_type(field.type)) for field in fields(Scores)]
    status = [pa.field(name, pa.string()) for name in (_STATUS, _REASON)]
    metadata = {_KEY: msgspec.json.encode(header)}
    return pa.schema([pa.field(_RUN, pa.string()), *parameters, *status, *scores], metadata=metadata)


def _arrow_type(hint: object) -> pa.DataType:
    kinds = {float: pa.float64(), int: pa.int64(), str: pa.string()}
    of = next(kind for kind in (*get_args(hint), hint) if kind in kinds)
    return kinds[of]


def _row(header: SweepHeader, values: Mapping[str, object]) -> Row:
    result = {_STATUS: values[_STATUS], _REASON: values[_REASON]}
    if values[_STATUS] == "measured":
        result["scores"] = {field.name: values[field.name] for field in fields(Scores)}
    of_run = [values[column.place] for column in header.parameters]
    return msgspec.convert({_RUN: values[_RUN], "values": of_run, "measured": result}, type=Row)
