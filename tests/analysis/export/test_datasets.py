"""LeRobot data sets follow the description of LeRobotDataset v3.0; foreign topics are exported or refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from tests.kit.answers import result_of

from dxlrun.log.log_reader import read_log
from dxlrun_analysis.export.lerobot import write_dataset

Export = Callable[..., tuple[int, str, list[str]]]
NAN = float("nan")
ROWS = (
    (0, (0.0, NAN), (NAN, NAN), (NAN, NAN)),
    (1, (0.1, 1.0), (NAN, 0.5), (2.0, NAN)),
    (4, (0.2, 1.1), (NAN, 0.6), (3.0, NAN)),
    (5, (0.3, 1.2), (NAN, NAN), (NAN, NAN)),
)
"""Cycles of two joints; those with the numbers 2 and 3 are missing."""


@pytest.mark.parametrize("to", ["csv", "parquet", "lerobot"])
def test_a_split_log_is_exported_as_a_whole_one(
    split: Path, run: Path, tmp_path: Path, export: Export, to: str
) -> None:
    said = [
        result_of(export(log, tmp_path / name, "--format", to, "--json")[1])
        for log, name in ((split, "split"), (run, "run"))
    ]
    counts = [one.get("rows") or one["frames"] for one in said]
    assert counts[0] == counts[1] > 70


def test_a_data_set_is_as_lerobot_describes_it(run: Path, tmp_path: Path, export: Export) -> None:
    root = tmp_path / "set"
    assert export(run, root, "--format", "lerobot")[0] == 0

    log = read_log(run)
    info = json.loads((root / "meta/info.json").read_text())
    frames = len(log.cycles)
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 50, frames)
    assert (info["total_episodes"], info["total_tasks"], info["splits"]) == (1, 1, {"train": "0:1"})
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [len(log.joints)],
        "names": [f"{joint}.pos" for joint in log.joints],
    }
    data = pq.read_table(root / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        stored = data.schema.field(name).type
        if feature["shape"] != [1]:
            assert stored.list_size == feature["shape"][0]
            stored = stored.value_type
        assert stored == pa.type_for_alias({"float32": "float", "int64": "int64"}[feature["dtype"]])
    np.testing.assert_array_equal(
        np.array(data["observation.state"].to_pylist()), log.cycles["position"].astype(np.float32)
    )
    np.testing.assert_array_equal(
        np.array(data["action"].to_pylist()), log.cycles["goal_position"].astype(np.float32)
    )
    np.testing.assert_allclose(data["timestamp"].to_numpy(), np.arange(frames) / 50, atol=1e-6)
    assert data["frame_index"].to_pylist() == data["index"].to_pylist() == list(range(frames))
    (episode,) = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["episode_index"], episode["length"], episode["dataset_to_index"]) == (0, frames, frames)
    tasks = pq.read_table(root / "meta/tasks.parquet")
    assert tasks["task"].to_pylist() == episode["tasks"]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    statistics = json.loads((root / "meta/stats.json").read_text())
    assert statistics.keys() == info["features"].keys()
    positions = log.cycles["position"].astype(np.float32).astype(float)
    for key, expected in (("mean", positions.mean(axis=0)), ("std", positions.std(axis=0))):
        np.testing.assert_allclose(statistics["observation.state"][key], expected, rtol=1e-9)
        np.testing.assert_allclose(episode[f"stats/observation.state/{key}"], expected, rtol=1e-9)


def test_frames_begin_with_the_first_goal_and_skipped_periods_repeat(
    made: Callable[..., Path], tmp_path: Path, export: Export
) -> None:
    log = made(*ROWS, skipped={4: 2})
    assert export(log, tmp_path / "set", "--format", "lerobot")[0] == 0

    data = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    first, last = [0.1, 1.0], [0.3, 1.2]
    expected = np.array([first, first, first, [0.2, 1.1], last])
    np.testing.assert_allclose(np.array(data["observation.state"].to_pylist()), expected, rtol=1e-6)
    goals = np.array([[2.0, 0.5]] * 3 + [[3.0, 0.6]] * 2)
    np.testing.assert_allclose(np.array(data["action"].to_pylist()), goals, rtol=1e-6)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["action"]["names"] == ["wheel.vel", "arm.pos"]


def test_cycles_that_are_missing_end_an_episode(
    made: Callable[..., Path], tmp_path: Path, export: Export
) -> None:
    """No frames are made up for them."""
    log = made(*ROWS)
    assert export(log, tmp_path / "set", "--format", "lerobot")[0] == 0

    data = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    states = np.array(data["observation.state"].to_pylist())
    np.testing.assert_allclose(states, [[0.1, 1.0], [0.2, 1.1], [0.3, 1.2]], rtol=1e-6)
    assert data["episode_index"].to_pylist() == [0, 1, 1]
    assert data["frame_index"].to_pylist() == [0, 0, 1]
    assert data["index"].to_pylist() == [0, 1, 2]
    np.testing.assert_allclose(data["timestamp"].to_numpy(), [0, 0, 0.02], rtol=1e-6)
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(one["length"], one["dataset_from_index"], one["dataset_to_index"]) for one in episodes] == [
        (1, 0, 1),
        (2, 1, 3),
    ]
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["splits"] == {"train": "0:2"}
    np.testing.assert_allclose(episodes[1]["stats/observation.state/mean"], [0.25, 1.15], rtol=1e-6)


def test_a_data_set_is_the_same_however_the_log_is_sliced(made: Callable[..., Path], tmp_path: Path) -> None:
    log = read_log(made(*ROWS, (6, (0.4, 1.3), (NAN, NAN), (1.0, NAN)), skipped={4: 2}))
    for size in (1, 2, 3, 9):
        parts = [replace(log, cycles=log.cycles[at : at + size]) for at in range(0, len(log.cycles), size)]
        reader = SimpleNamespace(path=log.path, slices=lambda parts=parts: iter(parts))
        assert write_dataset(reader, tmp_path / str(size)) == 6
    tables = [
        pq.read_table(tmp_path / str(size) / "data/chunk-000/file-000.parquet") for size in (1, 2, 3, 9)
    ]
    assert all(table.equals(tables[0]) for table in tables)
    figures = [json.loads((tmp_path / str(size) / "meta/stats.json").read_text()) for size in (1, 9)]
    for name, one in figures[0].items():
        for key, values in one.items():
            np.testing.assert_allclose(values, figures[1][name][key], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"period_ns": 16_000_000}, "needs a whole number of frames per second, not a rate of 62.5 Hz"),
        ({"shift_ns": 100_000_000}, "needs a constant rate, but the rate was changed, or the run was paused"),
    ],
)
def test_a_rate_that_a_data_set_cannot_have_is_refused(
    made: Callable[..., Path], tmp_path: Path, export: Export, options: dict[str, int], sentence: str
) -> None:
    log = made(*((n, (0.1, 1.0), (0.1, 0.5), (NAN, NAN)) for n in range(3)), **options)
    code, _, (error,) = export(log, tmp_path / "set", "--format", "lerobot")
    assert (code, list(tmp_path.iterdir())) == (2, [log])
    assert sentence in error


def test_a_log_without_goals_has_no_frames(made: Callable[..., Path], tmp_path: Path, export: Export) -> None:
    log = made((0, (0.1, 1.0), (NAN, NAN), (NAN, NAN)))
    code, _, (error,) = export(log, tmp_path / "set", "--format", "lerobot")
    assert (code, list(tmp_path.iterdir())) == (2, [log])
    assert "no frames: every cycle lacks" in error


def foreign(log: Path, made: Path, topic: str) -> Path:
    """Write a log anew, without the goals, and with topics of this name and of one that is alike."""
    with log.open("rb") as stream, made.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out)
        writer.start()
        summary = reader.get_summary()
        assert summary is not None
        kinds = {
            number: writer.register_schema(kind.name, kind.encoding, kind.data)
            for number, kind in summary.schemas.items()
        }
        channels: dict[int, list[int]] = {}
        for one in summary.channels.values():
            names = [topic, f"{topic}/"] if one.topic == "/goals" else [one.topic]
            kind = kinds[one.schema_id]
            channels[one.id] = [writer.register_channel(name, "cdr", kind, one.metadata) for name in names]
        for _, channel, message in reader.iter_messages(log_time_order=False):
            for number in channels[channel.id]:
                writer.add_message(
                    number, message.log_time, message.data, message.publish_time, message.sequence
                )
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return made


@pytest.mark.parametrize("to", ["csv", "parquet", "lerobot"])
@pytest.mark.parametrize(
    "topic", ["/a\0b", "/a\nb", "/../../out", "", "///", "/" + "x" * 400, "/\u202e", "/cycle/x"], ids=ascii
)
def test_a_topic_of_any_name_is_exported_or_refused_in_a_sentence(
    run: Path, tmp_path: Path, export: Export, topic: str, to: str
) -> None:
    log = foreign(run, tmp_path / "odd.mcap", topic)
    (tmp_path / "out").mkdir()
    code, _, errors = export(log, tmp_path / "out" / "out", "--format", to)
    assert not any("internal error" in line for line in errors)
    assert code in (0, 1, 2)
    assert {path.name for path in tmp_path.iterdir()} <= {"odd.mcap", "out"}
    if to == "parquet" and code == 0:
        assert len(list((tmp_path / "out" / "out").iterdir())) == 6  # one that is alike has a file of its own
