"""LeRobot: a log as a data set of one episode, in the layout of LeRobotDataset v3.0.

Source: Hugging Face LeRobot, docs "LeRobotDataset v3.0", and the names and types of columns that lerobot 0.4
writes: data/chunk-000/file-000.parquet with a row a frame, meta/info.json with features and rate,
meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet.

A frame is a period of the loop. `observation.state` is the position of each joint, `action` what was sent to
it: its goal position; of a joint that never got one its goal velocity, effort or PWM. Frames begin when every
joint has both. Periods that were skipped, and states that were lost, repeat the frame before: a servo keeps
its goal.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dxlrun.description.modes import COMMAND_INTERFACES
from dxlrun.errors import LogError
from dxlrun.log.reader import Log, LogReader

VERSION = "v3.0"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_PLACE = {"chunk_index": 0, "file_index": 0}
_SUFFIXES = {"position": "pos", "velocity": "vel", "effort": "effort", "pwm": "pwm"}
_STATE, _ACTION = "observation.state", "action"
_NUMBERS: tuple[tuple[str, str], ...] = (
    ("timestamp", "float32"),
    ("frame_index", "int64"),
    ("episode_index", "int64"),
    ("index", "int64"),
    ("task_index", "int64"),
)
_MOST_REPEATED = 100_000
"""Frames for periods without a record that are made at once: a log of a robot that was paused has a gap."""

Frames = NDArray[np.float32]


@dataclass(slots=True)
class _Statistics:
    """Minimum, maximum, mean and standard deviation of rows, taken in pieces."""

    count: int = 0
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None
    mean: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    """Sum of squared differences from the mean (Chan, Golub, LeVeque 1983: pairwise updates)."""

    def take(self, rows: NDArray[np.generic]) -> None:
        """Take rows, shape (rows, elements)."""
        values = rows.astype(np.float64)
        low, high, mean = values.min(axis=0), values.max(axis=0), values.mean(axis=0)
        squares = ((values - mean) ** 2).sum(axis=0)
        if self.low is None or self.high is None:
            self.count, self.low, self.high, self.mean, self.squares = len(values), low, high, mean, squares
            return
        total = self.count + len(values)
        shift = mean - self.mean
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
        self.squares = self.squares + squares + shift**2 * (self.count * len(values) / total)
        self.mean = self.mean + shift * (len(values) / total)
        self.count = total

    @property
    def values(self) -> dict[str, list[float]]:
        low, high = (np.zeros(1) if value is None else value for value in (self.low, self.high))
        deviation = np.sqrt(self.squares / max(self.count, 1))
        return {
            "min": low.tolist(),
            "max": high.tolist(),
            "mean": self.mean.tolist(),
            "std": deviation.tolist(),
            "count": [self.count],
        }


def write_dataset(reader: LogReader, directory: Path) -> int:
    """Write the data set into a directory that is made; return how many frames it has.

    Raises LogError where the log has none, or its rate is no whole number of Hz; OSError.
    """
    path = reader.path
    goals = _commanded(reader)
    last: Log | None = None
    statistics: dict[str, _Statistics] = {}
    frames = 0
    file = directory / _DATA.format(**_PLACE)
    file.parent.mkdir(parents=True)
    writer: pq.ParquetWriter | None = None
    try:
        for log, states, actions in _frames(reader, goals):
            last = log
            table = _table(states, actions, frames, _rate(log))
            writer = writer or pq.ParquetWriter(file, table.schema, compression="snappy")
            writer.write_table(table)
            rows = np.arange(frames, frames + len(states))
            found = {_STATE: states, _ACTION: actions, **_numbers(rows, _rate(log))}
            for name, values in found.items():
                statistics.setdefault(name, _Statistics()).take(values.reshape(len(rows), -1))
            frames += len(states)
    finally:
        if writer is not None:
            writer.close()
    if last is None:
        raise LogError(
            f"{path}: it has no cycle in which every joint had a position and a goal, so no frames"
        )
    features = _features(last, goals)
    figures = {name: one.values for name, one in statistics.items()}
    _write_meta(directory, last, features, figures, frames)
    return frames


def _commanded(reader: LogReader) -> dict[str, str]:
    """Return which command interface the joints were commanded by; joints that never were are left out."""
    seen: dict[str, NDArray[np.bool_]] = {}
    joints: tuple[str, ...] = ()
    for log in reader.slices():
        joints = log.joints
        for name in COMMAND_INTERFACES:
            found = np.isfinite(log.cycles[f"goal_{name}"]).any(axis=0)
            seen[name] = found | seen.get(name, np.zeros(len(joints), np.bool_))
    return {
        joint: next(name for name in COMMAND_INTERFACES if seen[name][row])
        for row, joint in enumerate(joints)
        if any(seen[name][row] for name in COMMAND_INTERFACES)
    }


def _frames(reader: LogReader, goals: Mapping[str, str]) -> Iterator[tuple[Log, Frames, Frames]]:
    """Yield states and actions, shape (frames, joints) and (frames, commanded joints), slice by slice."""
    held: tuple[Frames, Frames] | None = None
    expected = 0
    for log in reader.slices():
        cycles = log.cycles
        if not len(cycles):
            continue
        rows = [log.joints.index(joint) for joint in goals]
        columns = [cycles[f"goal_{goals[joint]}"][:, row] for joint, row in zip(goals, rows, strict=True)]
        states = np.where(cycles["age_ns"] >= 0, cycles["position"], np.nan).astype(np.float32)
        actions = np.empty((len(cycles), len(columns)), np.float32)
        for index, column in enumerate(columns):
            actions[:, index] = column
        numbers = cycles["cycle"].astype(np.int64)
        if held is not None:
            states, actions = np.vstack((held[0], states)), np.vstack((held[1], actions))
            numbers = np.insert(numbers, 0, expected - 1)
        states, actions = _filled(states), _filled(actions)
        whole = np.flatnonzero(np.isfinite(states).all(axis=1) & np.isfinite(actions).all(axis=1))
        if not (len(whole) and columns):
            continue
        first = int(whole[0])
        _check_rate(log)
        states, actions, numbers = states[first:], actions[first:], numbers[first:]
        times = np.minimum(np.diff(numbers, append=numbers[-1] + 1), _MOST_REPEATED)
        states, actions = np.repeat(states, times, axis=0), np.repeat(actions, times, axis=0)
        skip = 0 if held is None else 1  # the first was in the slice before
        held, expected = (states[-1:], actions[-1:]), int(numbers[-1]) + 1
        if len(states) > skip:
            yield log, states[skip:], actions[skip:]


def _filled(values: NDArray[np.floating]) -> Frames:
    """Return rows in which a value that is not known is that of the row before."""
    rows = np.where(np.isfinite(values), np.arange(len(values))[:, None], 0)
    np.maximum.accumulate(rows, axis=0, out=rows)
    filled: Frames = np.take_along_axis(values, rows, axis=0).astype(np.float32)
    return filled


def _check_rate(log: Log) -> None:
    rate = 1e9 / log.period_ns
    if abs(rate - round(rate)) > 1e-6 * rate:
        raise LogError(
            f"{log.path}: its rate is {rate:g} Hz, and a LeRobot data set has a whole number of frames "
            "a second"
        )
    due = log.cycles["scheduled_ns"].astype(np.int64)
    steps = np.diff(log.cycles["cycle"].astype(np.int64))
    if len(due) > 1 and np.any(np.abs(np.diff(due) - steps * log.period_ns) > log.period_ns // 2):
        raise LogError(
            f"{log.path}: its rate was changed or it was paused in the run, and a LeRobot data set has "
            "one rate"
        )


def _rate(log: Log) -> int:
    return round(1e9 / log.period_ns)


def _numbers(rows: NDArray[np.int64], rate: int) -> dict[str, NDArray[np.generic]]:
    zeros = np.zeros(len(rows), np.int64)
    values = (rows / rate, rows, zeros, rows, zeros)
    return {name: value.astype(kind) for (name, kind), value in zip(_NUMBERS, values, strict=True)}


def _table(states: Frames, actions: Frames, before: int, rate: int) -> pa.Table:
    rows = np.arange(before, before + len(states))
    columns = {_STATE: _vectors(states), _ACTION: _vectors(actions)}
    return pa.table(columns | {name: pa.array(values) for name, values in _numbers(rows, rate).items()})


def _vectors(values: Frames) -> pa.Array:
    """Return rows of numbers; a single number is one, as LeRobot has features of shape (1,)."""
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), pa.float32())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _features(log: Log, goals: Mapping[str, str]) -> dict[str, dict[str, object]]:
    actions = [f"{joint}.{_SUFFIXES[name]}" for joint, name in goals.items()]
    features: dict[str, dict[str, object]] = {
        _STATE: {
            "dtype": "float32",
            "shape": [len(log.joints)],
            "names": [f"{joint}.pos" for joint in log.joints],
        },
        _ACTION: {"dtype": "float32", "shape": [len(actions)], "names": actions},
    }
    return features | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _NUMBERS}


def _write_meta(
    directory: Path,
    log: Log,
    features: Mapping[str, object],
    figures: Mapping[str, Mapping[str, list[float]]],
    frames: int,
) -> None:
    task = f"recorded motion of {log.header.robot}"
    info = {
        "codebase_version": VERSION,
        "robot_type": log.header.robot,
        "total_episodes": 1,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": _rate(log),
        "splits": {"train": "0:1"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
    }
    episode: dict[str, object] = {
        "episode_index": 0,
        "tasks": [task],
        "length": frames,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": 0,
        "dataset_to_index": frames,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    episode |= {f"stats/{name}/{key}": v for name, one in figures.items() for key, v in one.items()}
    episodes = directory / _EPISODES.format(**_PLACE)
    episodes.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist([episode]), episodes)
    pq.write_table(_tasks(task), directory / "meta" / "tasks.parquet")
    for name, content in (("info", info), ("stats", figures)):
        (directory / "meta" / f"{name}.json").write_text(json.dumps(content, indent=4), encoding="utf-8")


def _tasks(task: str) -> pa.Table:
    """Return the table of tasks; pandas reads the task as its index, as LeRobot looks it up."""
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {
                "name": name,
                "field_name": name,
                "pandas_type": kind,
                "numpy_type": stored,
                "metadata": None,
            }
            for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([task])})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
