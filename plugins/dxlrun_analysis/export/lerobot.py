"""LeRobot export: episodes of logs as a data set, in the layout of LeRobotDataset v3.0.

Source: Hugging Face LeRobot, docs "LeRobotDataset v3.0", and the names and types of columns that lerobot 0.4
writes: data/chunk-000/file-000.parquet with a row per frame, meta/info.json with features and rate,
meta/stats.json, meta/tasks.parquet, meta/episodes/chunk-000/file-000.parquet.

`observation.state` is the position of each joint that observes, `action` the goal position of each joint that
acts; a joint that never received one has its goal velocity, effort or PWM. Policies such as ACT refuse a data
set that has neither images nor `observation.environment_state`; that has what the robot measures of its
environment: efforts of the joints that observe, and states of sensors and devices.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dxlrun import InputError, LogReader
from dxlrun_analysis.export.episodes import (
    FPS,
    Choice,
    Columns,
    EpisodeFrames,
    Survey,
    Values,
    columns_of,
    frames_of,
    survey,
)

VERSION = "v3.0"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_PLACE = {"chunk_index": 0, "file_index": 0}
_SUFFIXES = {"position": "pos", "velocity": "vel", "effort": "effort", "pwm": "pwm"}
_STATE, _ACTION, _ENVIRONMENT = "observation.state", "action", "observation.environment_state"
_NUMBERS: tuple[tuple[str, str], ...] = (
    ("timestamp", "float32"),
    ("frame_index", "int64"),
    ("episode_index", "int64"),
    ("index", "int64"),
    ("task_index", "int64"),
)
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


@dataclass(slots=True)
class Written:
    """Counts of a data set that was written."""

    fps: int
    columns: Columns
    frames: int = 0
    held: int = 0
    """Frames with a value that is not of their own period"""
    episodes: list[int] = field(default_factory=list)
    """Number of episodes of each log"""
    damage: list[str] = field(default_factory=list)
    """A sentence for each incomplete log"""


def write_dataset(readers: Sequence[LogReader], directory: Path, choice: Choice) -> Written:
    """Write logs as a LeRobot data set into a new directory.

    Raises:
        InputError: All logs that do not belong in one data set, and all joints without values.
        LogError: A log cannot be read.
        OSError: A file cannot be written.
    """
    surveys = [survey(reader) for reader in readers]
    columns = columns_of(surveys, choice)
    written = Written(_rate(surveys, choice.fps), columns)
    file = directory / _DATA.format(**_PLACE)
    file.parent.mkdir(parents=True)
    made = _Dataset(file, columns, written.fps)
    with closing(made):
        for one in surveys:
            before = len(made.episodes)
            for frames in frames_of(one, columns, written.fps):
                made.write_frames(frames)
                written.held += frames.held
            written.episodes.append(len(made.episodes) - before)
            written.damage += [f"{one.path}: {sentence}" for sentence in one.about.damage]
    _check_frames(surveys, written)
    written.frames = made.frames
    robot = surveys[0].about.header.robot
    _write_meta(directory, robot, choice.task or f"recorded motion of {robot}", made)
    return written


def _rate(surveys: Sequence[Survey], asked: int | None) -> int:
    """Return the frames per second. Raises InputError for more than the loop of a log has."""
    rates = [1e9 / one.about.period_ns for one in surveys]
    if asked is None:
        return max(1, min(FPS, int(min(rates) * (1 + 1e-6))))
    slow = [
        f"{one.path}: --fps {asked} is above the rate of its loop, {rate:.4g} Hz; give {rate:.0f} or less"
        for one, rate in zip(surveys, rates, strict=True)
        if asked > rate * (1 + 1e-6)
    ]
    if slow:
        raise InputError("\n".join(slow))
    return asked


def _check_frames(surveys: Sequence[Survey], written: Written) -> None:
    empty = [one for one, count in zip(surveys, written.episodes, strict=True) if not count]
    if empty:
        what = (
            "no frames: in no cycle all joints have a state and a goal; omit this log, or name other joints"
        )
        raise InputError("\n".join(f"{one.path}: {what}" for one in empty))


@dataclass(slots=True)
class _Episode:
    """One episode of the data set: its range of frames, and the statistics of its features."""

    begin: int
    end: int
    statistics: dict[str, _Statistics] = field(default_factory=dict)


class _Dataset:
    """Writer of the frames of a data set. Keeps the episodes and statistics for the metadata."""

    def __init__(self, file: Path, columns: Columns, fps: int) -> None:
        self.columns, self.fps = columns, fps
        self.episodes: list[_Episode] = []
        self.statistics: dict[str, _Statistics] = {}
        self._file = file
        self._writer: pq.ParquetWriter | None = None

    @property
    def frames(self) -> int:
        """Number of frames written so far."""
        return self.episodes[-1].end if self.episodes else 0

    def write_frames(self, frames: EpisodeFrames) -> None:
        """Write frames to the data file. Raises OSError."""
        if frames.begins:
            self.episodes.append(_Episode(self.frames, self.frames))
        episode = self.episodes[-1]
        index = np.arange(episode.end, episode.end + len(frames.values))
        numbers = _numbers(index, episode.begin, len(self.episodes) - 1, self.fps)
        ends = (0, *np.cumsum([len(names) for names in _names(self.columns).values()]).tolist())
        vectors = {
            name: frames.values[:, begin:end]
            for name, begin, end in zip(_names(self.columns), ends, ends[1:], strict=False)
        }
        columns = {name: _vectors(values) for name, values in vectors.items()}
        table = pa.table(columns | {name: pa.array(values) for name, values in numbers.items()})
        self._writer = self._writer or pq.ParquetWriter(self._file, table.schema, compression="snappy")
        self._writer.write_table(table)
        for name, values in {**vectors, **numbers}.items():
            for statistics in (self.statistics, episode.statistics):
                statistics.setdefault(name, _Statistics()).add_rows(values.reshape(len(index), -1))
        episode.end += len(index)

    def close(self) -> None:
        """Close the data file. Raises OSError."""
        if self._writer is not None:
            self._writer.close()


def _names(columns: Columns) -> dict[str, list[str]]:
    """Return the names of the elements of each vector, in the order of the values of frames."""
    names = {
        _STATE: [f"{joint}.pos" for joint in columns.observation],
        _ACTION: [f"{joint}.{_SUFFIXES[interface]}" for joint, interface in columns.action.items()],
        _ENVIRONMENT: list(columns.environment),
    }
    return {feature: elements for feature, elements in names.items() if elements}


def _numbers(index: NDArray[np.int64], begin: int, episode: int, rate: int) -> dict[str, NDArray[np.generic]]:
    frame, one = index - begin, np.ones(len(index), np.int64)
    values = (frame / rate, frame, episode * one, index, 0 * one)
    return {name: value.astype(kind) for (name, kind), value in zip(_NUMBERS, values, strict=True)}


def _vectors(values: Values) -> pa.Array:
    """Convert rows of numbers to an Arrow column of vectors.

    A row of one number becomes a plain number, as LeRobot has features of shape (1,).
    """
    flat = pa.array(np.ascontiguousarray(values).reshape(-1), pa.float32())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _features(columns: Columns) -> dict[str, dict[str, object]]:
    features: dict[str, dict[str, object]] = {
        feature: {"dtype": "float32", "shape": [len(names)], "names": names}
        for feature, names in _names(columns).items()
    }
    return features | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _NUMBERS}


def _write_meta(directory: Path, robot: str, task: str, made: _Dataset) -> None:
    info = {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": len(made.episodes),
        "total_frames": made.frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": made.fps,
        "splits": {"train": f"0:{len(made.episodes)}"},
        "data_path": _DATA,
        "video_path": None,
        "features": _features(made.columns),
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
