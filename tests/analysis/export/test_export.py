"""Exports hold what the log holds: CSV, Parquet, and data sets as LeRobotDataset v3.0 is described."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from msgspec import structs
from tests.kit.answers import result_of
from tests.kit.changed_logs import write_changed
from tests.kit.commands import Dxlrun, Said
from tests.kit.pages import page_text

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.ring import RecordKind
from dxlrun.errors import InputError
from dxlrun.log.log_reader import Log, open_log, read_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LoggedController, LogHeader
from dxlrun.output.target import new_target
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, simulated_robot
from dxlrun_analysis.export.arrow_tables import WITHOUT_TABLE, tables_of
from dxlrun_analysis.export.lerobot import write_dataset

ROBOTS = Path(__file__).parents[3] / "robots"
PERIOD_NS = 20_000_000
NAN = float("nan")
FORMATS = ["csv", "parquet", "lerobot"]
Export = Callable[..., Said]
Row = tuple[int, Sequence[float], Sequence[float], Sequence[float]]
"""Number of a cycle, positions, goals of position, goals of velocity."""
ROWS: tuple[Row, ...] = (
    (0, (0.0, NAN), (NAN, NAN), (NAN, NAN)),
    (1, (0.1, 1.0), (NAN, 0.5), (2.0, NAN)),
    (4, (0.2, 1.1), (NAN, 0.6), (3.0, NAN)),
    (5, (0.3, 1.2), (NAN, NAN), (NAN, NAN)),
)
"""Cycles of two joints; those with the numbers 2 and 3 are missing."""
STILL = tuple((number, (0.1, 1.0), (0.1, 0.5), (NAN, NAN)) for number in range(3))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a run of two arms with a motion; beside it a `split` one of the same run, in two parts."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=1.6, play=[ROBOTS / "motions/three_parts.yaml"])
    VirtualRobot(plan, log=path).run()
    parts = structs.replace(plan, recording=RecordingPlan(split_ns=1_000_000_000))
    VirtualRobot(parts, log=path.with_name("split")).run()
    return path


@pytest.fixture
def export(dxlrun: Dxlrun) -> Export:
    """Run `dxlrun export LOG OUT --format TO` in this process."""
    return lambda log, out, to, *words: dxlrun("export", log, out, "--format", to, *words)


def made(
    path: Path,
    rows: Sequence[Row] = ROWS,
    skipped: Mapping[int, int] | None = None,
    period_ns: int = PERIOD_NS,
    shift_ns: int = 0,
) -> Path:
    """Write a log of two joints from rows; all cycles but the first one are shifted."""
    joints = ("wheel", "arm")
    log = LogWriter(
        path, LogHeader("pair", joints, ("main",), (LoggedController("both", joints, ()),), period_ns, 0)
    )
    for number, positions, goals, speeds in rows:
        record = CycleRecord(CycleLayout(joints, ["both"]))
        due = 10**9 + number * period_ns + (shift_ns if number > rows[0][0] else 0)
        record.cycle, record.skipped = number, (skipped or {}).get(number, 0)
        record.scheduled_ns = record.woken_ns = record.read_ns = record.updated_ns = due
        record.written_ns = due
        record.states.position[:] = positions
        record.states.age_ns[:] = np.where(np.isfinite(positions), 0, -1)
        record.goals.position[:], record.goals.velocity[:] = goals, speeds
        log.write_record(RecordKind.CYCLE, record.raw)
    log.close()
    return path


def lines(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


# Tables


def test_parquet_has_every_record_of_the_log_and_names_topics_without_a_file(
    run: Path, tmp_path: Path, export: Export
) -> None:
    said = export(run, tmp_path / "out", "parquet", "--json")
    log, result = read_log(run), result_of(said.out)
    tables = {path.stem: pq.read_table(path) for path in (tmp_path / "out").iterdir()}
    counts = {name: len(table) for name, table in tables.items()}
    assert (said.code, result["rows"]) == (0, sum(counts.values()))
    assert counts == {
        "cycles": len(log.cycles),
        "packets": len(log.packets),
        "events": len(log.events),
        "commands": len(log.commands),
        "goals": len(log.topics["/goals"].data),
    }
    cycles, joint = tables["cycles"], log.joints[2]
    for column, values in (
        (f"{joint}/position_rad", log.cycles["position"][:, 2]),
        (f"{joint}/goal_position_rad", log.cycles["goal_position"][:, 2]),
        (f"{joint}/age_ms", log.cycles["age_ns"][:, 2] / 1e6),
        ("read_us", (log.cycles["read_ns"] - log.cycles["woken_ns"]) / 1e3),
        ("t_ns", log.cycles["scheduled_ns"]),
    ):
        np.testing.assert_array_equal(cycles[column].to_numpy(), values)
    assert set(cycles[f"{joint}/mode"].to_pylist()) == {"position"}
    packets = tables["packets"]
    assert packets["data"].to_pylist() == [packet.data for packet in log.packets]
    assert packets["servo_id"].to_pylist() == [packet.servo_id for packet in log.packets]
    assert [None if c < 0 else c for c in log.packets.cycle.tolist()] == packets["cycle"].to_pylist()
    goals, sent = tables["goals"], list(log.messages("/goals"))
    assert goals["progress"].to_pylist() == [message["progress"] for message in sent]
    stamps = [message["header"]["stamp"]["sec"] for message in sent]
    assert goals["header.stamp.sec"].to_pylist() == stamps
    assert set(stamps) == {0, 1}
    assert tables["events"]["text"].to_pylist() == [event.text for event in log.events]

    missing, topics = result["without_file"], open_log(run).topics
    in_files = {f"/{name}" for name in tables} | {"/cycle"}
    assert missing.keys() == {
        name for name in topics if not name.startswith("/bus/") and name not in in_files
    }
    assert missing["/joint_states"] == "the states are in /cycle"
    assert set(missing.values()) == {
        WITHOUT_TABLE.get(name, "the log has no message of this topic") for name in missing
    }
    said = export(run, tmp_path / "again", "parquet")
    assert (said.code, said.out.count("no file for ")) == (0, len(missing))
    assert "no file for /rosout: the same events are in /events" in said.out


@pytest.mark.parametrize(
    ("robot", "source", "state"),
    [("fall_reflex", "torso_imu", "linear_acceleration.z"), ("wolfgang", "core", "voltage")],
)
def test_states_of_sources_and_commands_of_devices_have_columns(
    tmp_path: Path, export: Export, robot: str, source: str, state: str
) -> None:
    run = tmp_path / "run.mcap"
    simulated_robot(ROBOTS / f"{robot}.yaml", duration_s=0.1, log=run).run()
    assert export(run, tmp_path / "out", "parquet").code == 0

    log, cycles = read_log(run), pq.read_table(tmp_path / "out" / "cycles.parquet")
    layout = log.header.layout
    row, place = layout.sources.index(source), layout.source_states.index(f"{source}/{state}")
    assert cycles[f"{source}/valid"].to_pylist() == log.cycles["source_valid"][:, row].tolist()
    assert any(cycles[f"{source}/valid"].to_pylist())
    known = [None if np.isnan(value) else value for value in log.cycles["source_state"][:, place].tolist()]
    assert cycles[f"{source}/{state}"].to_pylist() == known
    ages = [None if age < 0 else age / 1e6 for age in log.cycles["source_age_ns"][:, row].tolist()]
    assert cycles[f"{source}/age_ms"].to_pylist() == ages
    if layout.source_commands:
        device, _, name = layout.source_commands[0].partition("/")
        assert cycles[f"{device}/command.{name}"].to_pylist() == [None] * len(cycles)


def test_csv_has_a_line_a_cycle_or_a_record_and_nothing_where_nothing_is_known(
    run: Path, tmp_path: Path, export: Export
) -> None:
    rows = ((0, (0.5, NAN), (NAN, 0.25), (2.0, NAN)), (3, (0.6, 1.0), (NAN, 0.5), (2.0, NAN)))
    assert export(made(tmp_path / "made.mcap", rows), tmp_path / "out.csv", "csv").code == 0
    first, second = lines(tmp_path / "out.csv")
    assert (first["cycle"], second["cycle"], second["time_s"]) == ("0", "3", "0.06")
    assert (first["wheel/position_rad"], first["arm/position_rad"], first["arm/age_ms"]) == ("0.5", "", "")
    assert (first["wheel/goal_position_rad"], first["wheel/goal_velocity_rad_s"]) == ("", "2")

    for topic, name in (("/bus/main", "bus.csv"), ("/events", "events.csv")):
        assert export(run, tmp_path / name, "csv", "--topic", topic).code == 0
    log = read_log(run)
    packets, events = lines(tmp_path / "bus.csv"), lines(tmp_path / "events.csv")
    assert [packet["data"] for packet in packets] == [packet.data.hex() for packet in log.packets]
    assert [event["text"] for event in events] == [event.text for event in log.events]

    said = export(run, tmp_path / "run.csv", "csv", "--json")
    assert result_of(said.out)["without_file"].keys() == WITHOUT_TABLE.keys() & open_log(run).topics.keys()


@pytest.mark.parametrize("to", FORMATS)
def test_a_split_log_is_exported_as_a_whole_one(run: Path, tmp_path: Path, export: Export, to: str) -> None:
    logs = (run, run.with_name("split"))
    said = [result_of(export(log, tmp_path / log.name, to, "--json").out) for log in logs]
    counts = [one.get("rows") or one["frames"] for one in said]
    assert counts[0] == counts[1] > 70


def test_logs_md_its_exports_are_made(
    run: Path, tmp_path: Path, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    dxlrun export LOG (\S+) (.+)$", page_text("logs.md"), re.MULTILINE)
    assert len(commands) == 4
    for output, options in commands:
        assert dxlrun("export", run, output, *options.split()).code == 0, output
        assert Path(output).exists()


# Data sets


def frames(root: Path) -> Any:
    return pq.read_table(root / "data/chunk-000/file-000.parquet")


def test_a_data_set_is_as_lerobot_describes_it(run: Path, tmp_path: Path, export: Export) -> None:
    root = tmp_path / "set"
    assert export(run, root, "lerobot").code == 0

    log = read_log(run)
    info = json.loads((root / "meta/info.json").read_text())
    count = len(log.cycles)
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 50, count)
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
    for column, field in (("observation.state", "position"), ("action", "goal_position")):
        np.testing.assert_array_equal(
            np.array(data[column].to_pylist()), log.cycles[field].astype(np.float32)
        )
    np.testing.assert_allclose(data["timestamp"].to_numpy(), np.arange(count) / 50, atol=1e-6)
    assert data["frame_index"].to_pylist() == data["index"].to_pylist() == list(range(count))
    (episode,) = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["episode_index"], episode["length"], episode["dataset_to_index"]) == (0, count, count)
    tasks = pq.read_table(root / "meta/tasks.parquet")
    assert tasks["task"].to_pylist() == episode["tasks"]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    statistics = json.loads((root / "meta/stats.json").read_text())
    assert statistics.keys() == info["features"].keys()
    positions = log.cycles["position"].astype(np.float32).astype(float)
    for key, expected in (("mean", positions.mean(axis=0)), ("std", positions.std(axis=0))):
        np.testing.assert_allclose(statistics["observation.state"][key], expected, rtol=1e-9)
        np.testing.assert_allclose(episode[f"stats/observation.state/{key}"], expected, rtol=1e-9)


def test_frames_begin_with_the_first_goal_and_skipped_periods_repeat(tmp_path: Path, export: Export) -> None:
    assert export(made(tmp_path / "a.mcap", skipped={4: 2}), tmp_path / "set", "lerobot").code == 0
    data = frames(tmp_path / "set")
    states = np.array([[0.1, 1.0]] * 3 + [[0.2, 1.1], [0.3, 1.2]])
    np.testing.assert_allclose(np.array(data["observation.state"].to_pylist()), states, rtol=1e-6)
    goals = np.array([[2.0, 0.5]] * 3 + [[3.0, 0.6]] * 2)
    np.testing.assert_allclose(np.array(data["action"].to_pylist()), goals, rtol=1e-6)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["action"]["names"] == ["wheel.vel", "arm.pos"]


def test_cycles_that_are_missing_end_an_episode(tmp_path: Path, export: Export) -> None:
    """No frames are made up for them."""
    assert export(made(tmp_path / "a.mcap"), tmp_path / "set", "lerobot").code == 0
    data = frames(tmp_path / "set")
    states = np.array(data["observation.state"].to_pylist())
    np.testing.assert_allclose(states, [[0.1, 1.0], [0.2, 1.1], [0.3, 1.2]], rtol=1e-6)
    assert data["episode_index"].to_pylist() == [0, 1, 1]
    assert data["frame_index"].to_pylist() == [0, 0, 1]
    assert data["index"].to_pylist() == [0, 1, 2]
    np.testing.assert_allclose(data["timestamp"].to_numpy(), [0, 0, 0.02], rtol=1e-6)
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    keys = ("length", "dataset_from_index", "dataset_to_index")
    assert [tuple(one[key] for key in keys) for one in episodes] == [(1, 0, 1), (2, 1, 3)]
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["splits"] == {"train": "0:2"}
    np.testing.assert_allclose(episodes[1]["stats/observation.state/mean"], [0.25, 1.15], rtol=1e-6)


def test_actions_are_those_of_the_joints_that_have_goals(tmp_path: Path, export: Export) -> None:
    rows = tuple((number, (0.1, 1.0), (NAN, 0.5), (NAN, NAN)) for number in range(2))
    assert export(made(tmp_path / "a.mcap", rows), tmp_path / "set", "lerobot").code == 0
    assert frames(tmp_path / "set")["action"].to_pylist() == [0.5, 0.5]


def test_time_goes_on_through_the_slices_of_a_log(tmp_path: Path) -> None:
    log = read_log(made(tmp_path / "a.mcap"))
    slices = [replace(log, cycles=log.cycles[at : at + 1]) for at in range(len(log.cycles))]
    (rows,) = tables_of(slices, ["/cycle"])
    assert rows.table["time_s"].to_pylist() == pytest.approx([0.0, 0.02, 0.08, 0.1])


def test_a_data_set_is_the_same_however_the_log_is_sliced(tmp_path: Path) -> None:
    log = read_log(made(tmp_path / "a.mcap", (*ROWS, (6, (0.4, 1.3), (NAN, NAN), (1.0, NAN))), {4: 2}))
    sizes = (1, 2, 3, 9)
    for size in sizes:
        parts = [replace(log, cycles=log.cycles[at : at + size]) for at in range(0, len(log.cycles), size)]
        reader = SimpleNamespace(path=log.path, slices=lambda parts=parts: iter(parts))
        assert write_dataset(reader, tmp_path / str(size)) == 6
    tables = [frames(tmp_path / str(size)) for size in sizes]
    assert all(table.equals(tables[0]) for table in tables)
    figures = [json.loads((tmp_path / str(size) / "meta/stats.json").read_text()) for size in (1, 9)]
    assert len(figures[0]) > 5
    for name, one in figures[0].items():
        for key, values in one.items():
            np.testing.assert_allclose(values, figures[1][name][key], rtol=1e-9, atol=1e-12)


# What is refused


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"period_ns": 16_000_000}, "needs a whole number of frames per second, not a rate of 62.5 Hz"),
        ({"shift_ns": 10**8}, "needs a constant rate, but the rate was changed, or the run was paused"),
        ({"rows": ROWS[:1]}, "no frames: every cycle lacks"),
    ],
)
def test_a_log_that_cannot_be_a_data_set_is_refused(
    tmp_path: Path, export: Export, options: dict[str, Any], sentence: str
) -> None:
    log = made(tmp_path / "a.mcap", **{"rows": STILL, **options})
    said = export(log, tmp_path / "set", "lerobot")
    (error,) = said.errors
    assert (said.code, list(tmp_path.iterdir())) == (2, [log])
    assert sentence in error


@pytest.mark.parametrize(
    ("to", "topic", "sentence"),
    [
        ("csv", "/goal", "no records of /goal; did you mean /goals?"),
        ("csv", "/joint_states", "/joint_states has no table: the states are in /cycle"),
        ("parquet", "/goals", "--topic is only for csv, parquet has all topics"),
    ],
)
def test_a_wrong_topic_is_one_sentence_and_leaves_nothing(  # noqa: PLR0917  fixtures, and a case
    run: Path, tmp_path: Path, export: Export, to: str, topic: str, sentence: str
) -> None:
    said = export(run, tmp_path / "out", to, "--topic", topic)
    (error,) = said.errors
    assert (said.code, list(tmp_path.iterdir())) == (2, [])
    assert sentence in error


@pytest.mark.parametrize("to", FORMATS)
def test_nothing_is_written_over_and_a_log_that_cannot_be_read_leaves_nothing(
    run: Path, tmp_path: Path, export: Export, to: str
) -> None:
    there, broken = tmp_path / "there", tmp_path / "broken.mcap"
    there.write_text("precious")
    broken.write_bytes(b"not a log")
    for log, out, sentence in (
        (run, there, "there cannot be written (it exists"),
        (broken, tmp_path / "out", f"{broken}: this is not an MCAP file"),
        (run, tmp_path / "nowhere" / "out", "not found"),
    ):
        said = export(log, out, to)
        (error,) = said.errors
        assert (said.code, there.read_text(), sorted(tmp_path.iterdir())) == (2, "precious", [broken, there])
        assert sentence in error


def test_what_came_meanwhile_is_not_written_over(tmp_path: Path) -> None:
    target = tmp_path / "out"
    context = new_target(target)
    context.__enter__().write_text("new")
    target.write_text("came meanwhile")
    with pytest.raises(InputError, match="it exists"):
        context.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == [target]
    assert target.read_text() == "came meanwhile"


def test_a_full_disk_leaves_nothing_and_without_pyarrow_one_sentence_has_the_command(
    run: Path, tmp_path: Path, export: Export, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(pq.ParquetWriter, "write_table", full)
        said = export(run, tmp_path / "out", "parquet")
    assert (said.code, list(tmp_path.iterdir())) == (2, [])
    assert said.err.endswith("out cannot be written (No space left on device); choose another name\n")

    monkeypatch.setattr("dxlrun.errors.find_spec", lambda name: None)
    said = export(run, tmp_path / "out", "parquet")
    assert (said.code, said.errors) == (
        2,
        ["dxlrun: parquet needs pyarrow (not installed); install it: `pip install 'dxlrun[logs]'`"],
    )


def renamed(log: Log, name: str) -> Log:
    """Give the topic of the goals this name, and another one that is alike."""
    topics = {key: topic for key, topic in log.topics.items() if key != "/goals"}
    for one in (name, f"{name}/"):
        topics[one] = structs.replace(log.topics["/goals"], name=one)
    return replace(log, topics=topics)


@pytest.mark.parametrize("to", FORMATS)
@pytest.mark.parametrize(
    "topic", ["/a\0b", "/a\nb", "/../../out", "", "///", "/" + "x" * 400, "/\u202e", "/cycle/x"], ids=ascii
)
def test_a_topic_of_any_name_is_exported_or_refused_in_a_sentence(
    run: Path, tmp_path: Path, export: Export, topic: str, to: str
) -> None:
    log, out = tmp_path / "odd.mcap", tmp_path / "out" / "out"
    write_changed(run, log, lambda read: renamed(read, topic))
    out.parent.mkdir()
    said = export(log, out, to)
    assert "internal error" not in said.err
    assert said.code in (0, 1, 2)
    assert {path.name for path in tmp_path.iterdir()} <= {"odd.mcap", "out"}
    if to == "parquet" and said.code == 0:
        assert len(list(out.iterdir())) == 5  # one that is alike has a file of its own
