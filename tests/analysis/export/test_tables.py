"""CSV and Parquet hold what the log holds, with units, and null for what is not known."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_text

from dxlrun.errors import InputError
from dxlrun.log.log_reader import open_log, read_log
from dxlrun.output.target import new_target
from dxlrun.testing import simulated_robot
from dxlrun_analysis.export.arrow_tables import WITHOUT_TABLE

Export = Callable[..., tuple[int, str, list[str]]]
NAN = float("nan")
PAGE = page_text("logs.md")


ROBOTS = Path(__file__).parents[3] / "robots"


def lines(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_parquet_has_every_record_of_the_log(run: Path, tmp_path: Path, export: Export) -> None:
    code, said, _ = export(run, tmp_path / "out", "--format", "parquet", "--json")

    log = read_log(run)
    tables = {path.stem: pq.read_table(path) for path in (tmp_path / "out").iterdir()}
    counts = {name: len(table) for name, table in tables.items()}
    assert (code, result_of(said)["rows"]) == (0, sum(counts.values()))
    assert counts == {
        "cycles": len(log.cycles),
        "packets": len(log.packets),
        "events": len(log.events),
        "commands": len(log.commands),
        "goals": len(log.topics["/goals"].data),
    }
    cycles = tables["cycles"]
    joint = log.joints[2]
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
    goals = tables["goals"]
    sent = [message["progress"] for message in log.messages("/goals")]
    assert goals["progress"].to_pylist() == sent
    stamps = [message["header"]["stamp"]["sec"] for message in log.messages("/goals")]
    assert goals["header.stamp.sec"].to_pylist() == stamps
    assert set(stamps) == {0, 1}
    assert tables["events"]["text"].to_pylist() == [event.text for event in log.events]


def test_parquet_names_topics_without_a_file_and_the_reason(
    run: Path, tmp_path: Path, export: Export
) -> None:
    _, said, _ = export(run, tmp_path / "out", "--format", "parquet", "--json")
    missing = result_of(said)["without_file"]
    topics = open_log(run).topics
    files = {path.stem for path in (tmp_path / "out").iterdir()}
    assert missing.keys() == {
        name
        for name in topics
        if not name.startswith("/bus/") and name.strip("/").replace("cycle", "cycles") not in files
    }
    assert missing["/joint_states"] == "the states are in /cycle"
    reasons = {WITHOUT_TABLE.get(name, "the log has no message of this topic") for name in missing}
    assert set(missing.values()) == reasons
    code, said, _ = export(run, tmp_path / "again", "--format", "parquet")
    assert (code, said.count("no file for ")) == (0, len(missing))
    assert "no file for /rosout: the same events are in /events" in said


def test_csv_names_topics_that_it_cannot_have(run: Path, tmp_path: Path, export: Export) -> None:
    _, said, _ = export(run, tmp_path / "out.csv", "--format", "csv", "--json")
    assert result_of(said)["without_file"].keys() == WITHOUT_TABLE.keys() & open_log(run).topics.keys()
    code, _, errors = export(run, tmp_path / "other.csv", "--format", "csv", "--topic", "/joint_states")
    assert (code, "/joint_states has no table: the states are in /cycle" in errors[0]) == (2, True)


@pytest.mark.parametrize(
    ("robot", "source", "state"),
    [("fall_reflex", "torso_imu", "linear_acceleration.z"), ("wolfgang", "core", "voltage")],
)
def test_states_of_sources_and_commands_of_devices_have_columns(
    tmp_path: Path, export: Export, robot: str, source: str, state: str
) -> None:
    run = tmp_path / "run.mcap"
    simulated_robot(ROBOTS / f"{robot}.yaml", duration_s=0.1, log=run).run()
    assert export(run, tmp_path / "out", "--format", "parquet")[0] == 0

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


def test_csv_has_a_line_a_cycle_and_nothing_where_nothing_is_known(
    made: Callable[..., Path], tmp_path: Path, export: Export
) -> None:
    log = made((0, (0.5, NAN), (NAN, 0.25), (2.0, NAN)), (3, (0.6, 1.0), (NAN, 0.5), (2.0, NAN)))

    assert export(log, tmp_path / "out.csv", "--format", "csv")[0] == 0

    first, second = lines(tmp_path / "out.csv")
    assert (first["cycle"], second["cycle"], second["time_s"]) == ("0", "3", "0.06")
    assert (first["wheel/position_rad"], first["arm/position_rad"], first["arm/age_ms"]) == ("0.5", "", "")
    assert (first["wheel/goal_position_rad"], first["wheel/goal_velocity_rad_s"]) == ("", "2")


def test_csv_of_another_topic(run: Path, tmp_path: Path, export: Export) -> None:
    for topic, name in (("/bus/main", "bus.csv"), ("/events", "events.csv")):
        assert export(run, tmp_path / name, "--format", "csv", "--topic", topic)[0] == 0
    log = read_log(run)
    packets = lines(tmp_path / "bus.csv")
    assert [packet["data"] for packet in packets] == [packet.data.hex() for packet in log.packets]
    events = lines(tmp_path / "events.csv")
    assert [event["text"] for event in events] == [event.text for event in log.events]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--format", "csv", "--topic", "/goal"), "no records of /goal; did you mean /goals?"),
        (("--format", "parquet", "--topic", "/goals"), "--topic is only for csv, parquet has all topics"),
    ],
)
def test_a_wrong_topic_is_one_sentence_and_leaves_nothing(
    run: Path, tmp_path: Path, export: Export, words: tuple[str, ...], sentence: str
) -> None:
    code, _, errors = export(run, tmp_path / "out", *words)
    assert (code, len(errors), list(tmp_path.iterdir())) == (2, 1, [])
    assert sentence in errors[0]


@pytest.mark.parametrize("to", ["csv", "parquet", "lerobot"])
def test_nothing_is_written_over_and_a_log_that_cannot_be_read_leaves_nothing(
    run: Path, tmp_path: Path, export: Export, to: str
) -> None:
    there = tmp_path / "there"
    there.write_text("precious")
    code, _, (error,) = export(run, there, "--format", to)
    assert (code, there.read_text()) == (2, "precious")
    assert "there cannot be written (it exists" in error

    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a log")
    code, _, (error,) = export(broken, tmp_path / "out", "--format", to)
    assert (code, sorted(tmp_path.iterdir())) == (2, [broken, there])
    assert f"{broken}: this is not an MCAP file" in error

    code, _, (error,) = export(run, tmp_path / "nowhere" / "out", "--format", to)
    assert code == 2
    assert "not found" in error


def test_what_came_meanwhile_is_not_written_over(tmp_path: Path) -> None:
    target = tmp_path / "out"
    context = new_target(target)
    context.__enter__().write_text("new")
    target.write_text("came meanwhile")
    with pytest.raises(InputError, match="it exists"):
        context.__exit__(None, None, None)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert target.read_text() == "came meanwhile"


def test_a_full_disk_leaves_nothing(
    run: Path, tmp_path: Path, export: Export, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", full)
    code, _, (error,) = export(run, tmp_path / "out", "--format", "parquet")
    assert (code, list(tmp_path.iterdir())) == (2, [])
    assert error.endswith("out cannot be written (No space left on device); choose another name")


def test_logs_md_its_exports_are_made(
    run: Path, tmp_path: Path, export: Export, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = re.findall(r"^    dxlrun export (.+)$", PAGE, re.MULTILINE)
    assert len(lines) == 4
    for line in lines:
        log, output, *options = line.split()
        assert log == "LOG"
        assert export(run, output, *options)[0] == 0, line
        assert Path(output).exists()


def test_without_pyarrow_one_sentence_has_the_command(
    run: Path, tmp_path: Path, export: Export, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dxlrun.errors.find_spec", lambda name: None)
    code, _, errors = export(run, tmp_path / "out", "--format", "parquet")
    assert code == 2
    assert errors == [
        "dxlrun: parquet needs pyarrow (not installed); install it: `pip install 'dxlrun[logs]'`"
    ]
