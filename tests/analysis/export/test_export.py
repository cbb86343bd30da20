"""Exports hold what the log holds: CSV and Parquet; what every export refuses."""

import csv
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec import structs
from tests.analysis.export.conftest import NAN, ROBOTS, made
from tests.kit.answers import result_of
from tests.kit.changed_logs import write_changed
from tests.kit.commands import cases, play
from tests.kit.pages import page_text

from dxlrun.errors import InputError
from dxlrun.log.log_reader import Log, open_log, read_log
from dxlrun.output.target import new_target
from dxlrun.testing import simulated_robot
from dxlrun_analysis.export.arrow_tables import WITHOUT_TABLE, tables_of

pytestmark = pytest.mark.long

FORMATS = ["csv", "parquet", "lerobot"]


def lines(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_parquet_has_every_record_of_the_log_and_names_topics_without_a_file(run, tmp_path, export):
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
def test_states_of_sources_and_commands_of_devices_have_columns(tmp_path, export, robot, source, state):
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


def test_csv_has_a_line_a_cycle_or_a_record_and_nothing_where_nothing_is_known(run, tmp_path, export):
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
def test_a_split_log_is_exported_as_a_whole_one(run, tmp_path, export, to):
    logs = (run, run.with_name("split"))
    said = [result_of(export(log, tmp_path / log.name, to, "--json").out) for log in logs]
    counts = [one.get("rows") or one["frames"] for one in said]
    assert counts[0] == counts[1] > 40


def test_logs_md_its_exports_are_made(run, tmp_path, dxlrun, monkeypatch):
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    dxlrun (export .+)$", page_text("logs.md"), re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        logs = iter((str(run), str(run.with_name("split"))))
        words = [next(logs) if word == "LOG" else word for word in shlex.split(command)]
        assert dxlrun(*words).code == 0, command
        assert Path(words[words.index("--format") - 1]).exists()


def test_time_goes_on_through_the_slices_of_a_log(tmp_path):
    log = read_log(made(tmp_path / "a.mcap"))
    slices = [replace(log, cycles=log.cycles[at : at + 1]) for at in range(len(log.cycles))]
    (rows,) = tables_of(slices, ["/cycle"])
    assert rows.table["time_s"].to_pylist() == pytest.approx([0.0, 0.02, 0.08, 0.1])


@pytest.mark.parametrize("case", cases(Path(__file__).with_name("refusals.txt")))
def test_refused(run, tmp_path, monkeypatch, dxlrun, case):
    monkeypatch.chdir(tmp_path)
    Path("run.mcap").symlink_to(run)
    made(Path("a.mcap"))
    made(Path("other.mcap"), robot="twin")
    made(Path("joints.mcap"), joints=("wheel", "leg"))
    made(Path("still.mcap"), [(n, (0.1, 1.0), (NAN, NAN), (NAN, NAN)) for n in range(3)])
    made(Path("deaf.mcap"), [(n, (0.1, NAN), (NAN, 0.5), (NAN, NAN)) for n in range(3)])
    apart = [(n, (0.1, 1.0), (0.1, NAN if n < 3 else 0.5), (NAN, NAN)) for n in range(6)]
    made(Path("apart.mcap"), apart, silent=dict.fromkeys(range(3, 6), 9))
    play(case, dxlrun)


def test_what_came_meanwhile_is_not_written_over(tmp_path):
    target = tmp_path / "out"
    context = new_target(target)
    context.__enter__().write_text("new")
    target.write_text("came meanwhile")
    with pytest.raises(InputError, match="it exists"):
        context.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == [target]
    assert target.read_text() == "came meanwhile"


def test_a_full_disk_leaves_nothing_and_without_pyarrow_one_sentence_has_the_command(
    run, tmp_path, export, monkeypatch
):
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
def test_a_topic_of_any_name_is_exported_or_refused_in_a_sentence(run, tmp_path, export, topic, to):
    log, out = tmp_path / "odd.mcap", tmp_path / "out" / "out"
    write_changed(run, log, lambda read: renamed(read, topic))
    out.parent.mkdir()
    said = export(log, out, to)
    assert "internal error" not in said.err
    assert said.code in (0, 1, 2)
    assert {path.name for path in tmp_path.iterdir()} <= {"odd.mcap", "out"}
    if to == "parquet" and said.code == 0:
        assert len(list(out.iterdir())) == 5  # one that is alike has a file of its own
