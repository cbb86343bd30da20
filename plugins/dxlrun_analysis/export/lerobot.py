"""LeRobot export: joint states and goals of a log as a data set, in the layout of LeRobotDataset v3.0.

Source: Hugging Face LeRobot, docs "LeRobotDataset v3.0", and the names and types of columns that lerobot 0.4
writes: data/chunk-000/file-000.parquet with a row per frame, meta/info.json with features and rate,
meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet.

A frame is a period of the loop. `observation.state` is the position of each joint, `action` its goal
position; a joint that never received one has its goal velocity, effort or PWM. Frames begin when every joint
has both. Skipped periods and lost states repeat the preceding frame, because a servo keeps its goal. After
cycles that are missing for another reason, a new episode begins.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dxlrun import Log, LogError, LogReader
from dxlwire import COMMAND_INTERFACES

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
Frames = NDArray[np.float32]
Floats = NDArray[np.float64]


@dataclass(slots=True)
class _Statistics:
    """Minimum, maximum, mean and standard deviation of one feature of the data set, updated in batches."""

    count: int = 0
    low: Floats = field(default_factory=lambda: np.full(1, np.inf))
    high: Floats = field(default_factory=lambda: np.full(1, -np.inf))
    mean: Floats = field(default_factory=lambda: np.zeros(1))
    squares: Floats = field(default_factory=lambda: np.zeros(1))
    """Sum of squared differences from the mean (Chan, Golub, LeVeque 1983: pairwise updates)."""

    def add_rows(self, rows: NDArray[np.generic]) -> None:
        """Add the feature's values in some frames, shape (frames, elements)."""
        values = rows.astype(np.float64)
        mean = values.mean(axis=0)
        total, shift = self.count + len(values), mean - self.mean
        self.low = np.minimum(self.low, values.min(axis=0))
        self.high = np.maximum(self.high, values.max(axis=0))
        squares = ((values - mean) ** 2).sum(axis=0)
        self.squares = self.squares + squares + shift**2 * (self.count * len(values) / total)
        self.mean = self.mean + shift * (len(values) / total)
        self.count = total

    @property
    def values(self) -> dict[str, list[float]]:
        return {
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.squares / max(self.count, 1)).tolist(),
            "count": [self.count],
        }


def write_dataset(reader: LogReader, directory: Path) -> int:
    """Write a log as a LeRobot data set into a new directory; return the number of frames.

    Raises:
        LogError: The log has no frames, or its rate is not a whole number of Hz.
        OSError: A file cannot be written.
    """
    goals = _commanded(reader)
    file = directory / _DATA.format(**_PLACE)
    file.parent.mkdir(parents=True)
    made = _Dataset(file)
    with closing(made):
        for stretch in _stretches(reader, goals):
            made.write_frames(stretch)
    if made.last is None:
        raise LogError(f"{reader.path}: no frames: every cycle lacks the position or the goal of a joint")
    _write_meta(directory, made.last, _features(made.last, goals), made)
    return made.frames


class _Stretch(msgspec.Struct, frozen=True, eq=False):
    """Consecutive frames of one slice of the log: states and goals of all joints."""

    log: Log
    states: Frames  # Shape (frames, joints)
    actions: Frames  # Shape (frames, commanded joints)
    begins: bool  # The frames do not continue the preceding ones: an episode begins


@dataclass(slots=True)
class _Episode:
    """One episode of the data set: its range of frames, and the statistics of its features."""

    begin: int
    end: int
    statistics: dict[str, _Statistics] = field(default_factory=dict)


class _Dataset:
    """Writer of the frames of a data set. Keeps the episodes and statistics for the metadata."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._writer: pq.ParquetWriter | None = None
        self.episodes: list[_Episode] = []
        self.statistics: dict[str, _Statistics] = {}
        self.last: Log | None = None

    @property
    def frames(self) -> int:
        """Number of frames written so far."""
        return self.episodes[-1].end if self.episodes else 0

    def write_frames(self, stretch: _Stretch) -> None:
        """Write frames to the data file. Raises OSError."""
        self.last = stretch.log
        if stretch.begins:
            self.episodes.append(_Episode(self.frames, self.frames))
        episode = self.episodes[-1]
        index = np.arange(episode.end, episode.end + len(stretch.states))
        numbers = _numbers(index, episode.begin, len(self.episodes) - 1, _rate(stretch.log))
        columns = {_STATE: _vectors(stretch.states), _ACTION: _vectors(stretch.actions)}
        table = pa.table(columns | {name: pa.array(values) for name, values in numbers.items()})
        self._writer = self._writer or pq.ParquetWriter(self._file, table.schema, compression="snappy")
        self._writer.write_table(table)
        for name, values in {_STATE: stretch.states, _ACTION: stretch.actions, **numbers}.items():
            for statistics in (self.statistics, episode.statistics):
                statistics.setdefault(name, _Statistics()).add_rows(values.reshape(len(index), -1))
        episode.end += len(index)

    def close(self) -> None:
        """Close the data file. Raises OSError."""
        if self._writer is not None:
            self._writer.close()


def _commanded(reader: LogReader) -> dict[str, str]:
    """Return the command interface of each joint that received goals: position if any was sent, else
    velocity, effort or PWM."""
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


def _stretches(reader: LogReader, goals: Mapping[str, str]) -> Iterator[_Stretch]:
    """Yield the frames of a log, slice by slice; `goals` has the command interface of each joint.

    Raises:
        LogError: A data set cannot have this rate.
    """
    held: tuple[Frames, Frames, NDArray[np.void]] | None = None
    begun = False
    for log in reader.slices():
        cycles = log.cycles
        if not (len(cycles) and goals):
            continue
        states = np.where(cycles["age_ns"] >= 0, cycles["position"], np.nan).astype(np.float32)
        actions = np.empty((len(cycles), len(goals)), np.float32)
        for index, (joint, name) in enumerate(goals.items()):
            actions[:, index] = cycles[f"goal_{name}"][:, log.joints.index(joint)]
        # The newest row of the preceding slice is repeated until the first row of this one.
        if held is not None:
            states, actions = np.vstack((held[0], states)), np.vstack((held[1], actions))
            cycles = np.concatenate((held[2], cycles))
        states, actions = _filled(states), _filled(actions)
        known = held is not None
        held = states[-1:], actions[-1:], cycles[-1:]
        whole = np.flatnonzero(np.isfinite(states).all(axis=1) & np.isfinite(actions).all(axis=1))
        steps: NDArray[np.int64] = np.diff(cycles["cycle"])
        follows = steps == cycles["skipped"][1:].astype(np.int64) + 1
        _check_rate(log, cycles, steps, follows)
        first = int(whole[0]) if len(whole) else len(cycles)
        cuts = [first, *(np.flatnonzero(~follows[first:]) + first + 1).tolist(), len(cycles)]
        for begin, end in itertools.pairwise(cuts):
            if begin == end:
                continue
            times = np.append(steps[begin : end - 1], 1)
            # The row was already yielded with the preceding slice.
            before = int(known and begun and begin == 0)
            rows = np.repeat(np.arange(begin, end), times)[before:]
            if len(rows):
                yield _Stretch(log, states[rows], actions[rows], not before)
            begun = True


def _filled(values: NDArray[np.floating]) -> Frames:
    """Return rows in which each unknown value is replaced by that of the preceding row."""
    rows = np.where(np.isfinite(values), np.arange(len(values))[:, None], 0)
    np.maximum.accumulate(rows, axis=0, out=rows)
    filled: Frames = np.take_along_axis(values, rows, axis=0).astype(np.float32)
    return filled


def _check_rate(
    log: Log, cycles: NDArray[np.void], steps: NDArray[np.int64], follows: NDArray[np.bool_]
) -> None:
    rate = 1e9 / log.period_ns
    if abs(rate - round(rate)) > 1e-6 * rate:
        raise LogError(
            f"{log.path}: a LeRobot data set needs a whole number of frames per second, not a "
            f"rate of {rate:g} Hz"
        )
    off = np.abs(np.diff(cycles["scheduled_ns"].astype(np.int64)) - steps * log.period_ns)
    if np.any(off[follows] > log.period_ns // 2):
        raise LogError(
            f"{log.path}: a LeRobot data set needs a constant rate, but the rate was changed, or "
            "the run was paused"
        )


def _rate(log: Log) -> int:
    return round(1e9 / log.period_ns)


def _numbers(index: NDArray[np.int64], begin: int, episode: int, rate: int) -> dict[str, NDArray[np.generic]]:
    frame, one = index - begin, np.ones(len(index), np.int64)
    values = (frame / rate, frame, episode * one, index, 0 * one)
    return {name: value.astype(kind) for (name, kind), value in zip(_NUMBERS, values, strict=True)}


def _vectors(values: Frames) -> pa.Array:
    """Convert rows of numbers to an Arrow column of vectors.

    A row of one number becomes a plain number, as LeRobot has features of shape (1,).
    """
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


def _write_meta(directory: Path, log: Log, features: Mapping[str, object], made: _Dataset) -> None:
    task = f"recorded motion of {log.header.robot}"
    info = {
        "codebase_version": VERSION,
        "robot_type": log.header.robot,
        "total_episodes": len(made.episodes),
        "total_frames": made.frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": _rate(log),
        "splits": {"train": f"0:{len(made.episodes)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": features,
    }
    rows: list[dict[str, object]] = []
    for number, episode in enumerate(made.episodes):
        row: dict[str, object] = {
            "episode_index": number,
            "tasks": [task],
            "length": episode.end - episode.begin,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": episode.begin,
            "dataset_to_index": episode.end,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, one in episode.statistics.items():
            row |= {f"stats/{name}/{key}": values for key, values in one.values.items()}
        rows.append(row)
    episodes = directory / _EPISODES.format(**_PLACE)
    episodes.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(rows), episodes)
    pq.write_table(_tasks(task), directory / "meta" / "tasks.parquet")
    statistics = {name: one.values for name, one in made.statistics.items()}
    for name, content in (("info", info), ("stats", statistics)):
        (directory / "meta" / f"{name}.json").write_text(json.dumps(content, indent=4), encoding="utf-8")


def _tasks(task: str) -> pa.Table:
    """Return the content of meta/tasks.parquet. Its metadata make the task the index, as LeRobot expects."""
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
            for name, kind, stored in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([task])})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
