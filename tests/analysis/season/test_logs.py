"""`dxlrun logs`: rows as the analysis has them, converted once, asked in SQL that can only read."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from pathlib import Path
from types import SimpleNamespace

import dask
import numpy as np
import pytest
from distributed import LocalCluster, Security

from dxlrun.log.log_writer import LogWriter
from dxlrun.log.reader import read_log
from dxlrun.log.schemas import LogHeader
from dxlrun.testing import simulated_robot
from dxlrun_analysis.latency import latency_log
from dxlrun_analysis.report import analyze_log
from dxlrun_analysis.season import cache, conversion
from dxlrun_analysis.season.cache import Cache, code_version, content_key
from dxlrun_analysis.season.conversion import Converted
from dxlrun_analysis.season.pools import processes
from dxlrun_analysis.season.season import converted, find_logs

Dxlrun = Callable[..., SimpleNamespace]
NAMES = ["first.mcap", "may/broken.mcap", "may/copy.mcap", "may/second.mcap", "may/third.mcap"]
ROBOTS = Path(__file__).parents[3] / "robots"


def rows(said: SimpleNamespace) -> dict[str, dict[str, object]]:
    assert said.code == 0, said.errors
    return {row["log"]: row for row in json.loads(said.out)["rows"]}


def test_rows_are_what_the_analysis_of_each_log_has(season: Path, here: object, dxlrun: Dxlrun) -> None:
    found = rows(dxlrun("logs", season, "--json"))

    assert list(found) == NAMES
    for name, row in found.items():
        if name == "may/broken.mcap":
            assert row["unreadable"] == "this is no MCAP file, so it is no log of dxlrun"
            assert row["robot"] is None
            continue
        report = analyze_log(season / name)
        assert row["robot"] == report.robot
        assert row["good"] == report.verdict.good
        assert row["cycles"] == report.periods.records
        assert row["lasted_s"] == pytest.approx(report.periods.seconds)
        assert row["asked"] == sum(servo.asked for servo in report.servos)
        assert row["sentence"] == report.verdict.findings[1].sentence
        assert row["bytes"] == (season / name).stat().st_size
        temperature = read_log(season / name).cycles["temperature"]
        assert row["hottest_deg_c"] == np.nanmax(temperature)
    assert {k: v for k, v in found["may/copy.mcap"].items() if k != "log"} == {
        k: v for k, v in found["first.mcap"].items() if k != "log"
    }


def test_the_second_time_no_log_is_opened_and_a_changed_one_alone_is_converted_again(
    known: Path, here: SimpleNamespace, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = rows(dxlrun("logs", known, "--json"))
    assert len(here.jobs) == len(NAMES)
    opened: list[str] = []
    open_path = Path.open

    def watched(path: Path, *arguments: object, **options: object) -> object:
        opened.append(path.name)
        return open_path(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", watched)
    for path in known.rglob("*.mcap"):
        path.chmod(0o600)  # a change too: all are looked at again, and their content is known
    rows(dxlrun("logs", known, "--json"))
    assert len([name for name in opened if name.endswith(".mcap")]) == len(NAMES)
    opened.clear()
    here.jobs.clear()
    assert rows(dxlrun("logs", known, "--json")) == first
    assert (here.jobs, [name for name in opened if name.endswith(".mcap")]) == ([], [])

    shutil.copy(known / "may/third.mcap", known / "first.mcap")
    changed = rows(dxlrun("logs", known, "--json"))
    assert len(here.jobs) == 1
    assert changed["first.mcap"]["robot"] == "single_joint"
    assert changed["may/copy.mcap"]["robot"] == "bioloid_torso"


def test_the_same_content_is_converted_once(
    season: Path, here: SimpleNamespace, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    analyzed: list[str] = []
    analyze = conversion.analyze

    def counting(reader: SimpleNamespace, *watching: object) -> object:
        analyzed.append(reader.path.name)
        return analyze(reader, *watching)

    monkeypatch.setattr(conversion, "analyze", counting)
    dxlrun("logs", season)
    assert sorted(analyzed) == ["first.mcap", "second.mcap", "third.mcap"]  # broken.mcap is no log


def test_a_file_that_changes_within_its_clocks_tick_is_looked_at_again(
    season: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As git's index: same size, same times, other bytes."""
    monkeypatch.setattr(cache, "_SETTLED_NS", 2_000_000_000)
    log = season / "first.mcap"
    files = [log]
    store = Cache(tmp_path / "store", "code")
    (store.tables / "key").mkdir()
    (store.tables / "key" / "logs.parquet").touch()
    cache.seal(store.tables / "key")
    store.remember(log, cache.stamps(files), "key", time.time_ns())
    assert store.key(log, files) is None
    store.remember(log, cache.stamps(files), "key", time.time_ns() + 3_000_000_000)
    assert store.key(log, files) == "key"
    store.save()
    assert Cache(tmp_path / "store", "code").key(log, files) == "key"
    os.utime(log, ns=(1, 1))
    assert store.key(log, files) is None


def test_the_key_is_that_of_all_bytes_of_all_parts(tmp_path: Path) -> None:
    def key(*parts: bytes) -> str:
        files = [tmp_path / str(number) for number in range(len(parts))]
        for file, part in zip(files, parts, strict=True):
            file.write_bytes(part)
        return content_key(files)

    big = bytes(3 << 20)
    keys = {key(b"ab", b"c"), key(b"a", b"bc"), key(b"abc"), key(big), key(big[:-1] + b"\1"), key(big, b"")}
    assert len(keys) == 6


def test_a_log_that_changes_while_it_is_read_gives_no_tables_to_what_it_was(
    season: Path, here: object, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_log = conversion.open_log
    log, other = season / "first.mcap", season / "may" / "third.mcap"
    before = log.read_bytes()

    def changing(path: Path) -> object:
        if path == log:
            shutil.copy(other, log)
        return open_log(path)

    (season / "may" / "copy.mcap").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(conversion, "open_log", changing)
        assert rows(dxlrun("logs", season, "--json"))["first.mcap"]["robot"] == "single_joint"
    (season / "later.mcap").write_bytes(before)
    found = rows(dxlrun("logs", season, "--json"))
    assert found["later.mcap"]["robot"] == "bioloid_torso"
    assert found["first.mcap"]["robot"] == "single_joint"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--where", "robot = 'single_joint'"), ["may/third.mcap"]),
        (("--where", "unreadable IS NOT NULL"), ["may/broken.mcap"]),
        (("--where", "cycles > 30", "--sort", "cycles DESC"), ["may/third.mcap", "may/second.mcap"]),
        (("--where", "log IN (SELECT log FROM servos WHERE bus = 'main' AND servo_id = 21)"), 3),
        (("--where", "log IN (SELECT log FROM cycles WHERE cycle = 39)"), 2),
        (("--where", "log IN (SELECT log FROM joints WHERE joint = 'joint')"), ["may/third.mcap"]),
        (("--where", "log IN (SELECT log FROM events WHERE name = 'torque_on')"), 4),
        (("--where", "log IN (SELECT log FROM findings WHERE finding = 'rate_kept')"), 4),
        (("--where", "robot LIKE 'bio%' -- and no more"), 3),
        (("--sort", "log DESC"), NAMES[::-1]),
    ],
)
def test_conditions_use_every_table(
    known: Path, here: object, dxlrun: Dxlrun, words: tuple[str, ...], expected: list[str] | int
) -> None:
    found = list(rows(dxlrun("logs", known, "--json", *words)))
    assert (len(found) if isinstance(expected, int) else found) == expected


def test_a_whole_statement_groups_and_joins(known: Path, here: object, dxlrun: Dxlrun) -> None:
    statement = (
        "SELECT robot, count(DISTINCT logs.log) AS runs, max(cycles.late_us) AS worst FROM logs JOIN cycles "
        "USING (log) GROUP BY robot ORDER BY robot"
    )
    said = dxlrun("logs", known, "--sql", statement, "--json")
    assert [(row["robot"], row["runs"]) for row in json.loads(said.out)["rows"]] == [
        ("bioloid_torso", 3),
        ("single_joint", 1),
    ]
    assert "bioloid_torso" in dxlrun("logs", known, "--sql", statement).out


def test_columns_of_the_same_name_and_decimal_numbers_are_in_the_json(
    known: Path, here: object, dxlrun: Dxlrun
) -> None:
    statement = (
        "SELECT a.lost, b.lost, b.lost AS lost, sum(a.cycles) * 1.5 AS half_more FROM logs a JOIN servos b "
        "USING (log) WHERE log = 'may/third.mcap' GROUP BY ALL"
    )
    (row,) = json.loads(dxlrun("logs", known, "--sql", statement, "--json").out)["rows"]
    cycles = rows(dxlrun("logs", known, "--json"))["may/third.mcap"]["cycles"]
    assert row == {"lost": 0, "lost_2": 0, "lost_3": 0, "half_more": pytest.approx(1.5 * cycles)}


def test_names_that_are_not_utf_8_and_pipes_hide_no_log(
    known: Path, here: SimpleNamespace, dxlrun: Dxlrun
) -> None:
    strange = os.fsdecode(b"\xff.mcap")
    shutil.copy(known / "first.mcap", known / strange)
    os.mkfifo(known / "pipe.mcap")
    (known / "gone.mcap").symlink_to("nowhere")
    for _ in range(2):
        found = rows(dxlrun("logs", known, "--json"))
        assert sorted(set(found) - set(NAMES)) == ["\\udcff.mcap", "gone.mcap"]
        assert found["\\udcff.mcap"]["robot"] == "bioloid_torso"
        assert found["gone.mcap"]["unreadable"] == "cannot be read: No such file or directory"
    assert "pipe.mcap" in json.loads(dxlrun("logs", known, "--json").out)["other_files"]


def test_logs_md_its_questions_are_answered(known: Path, here: object, dxlrun: Dxlrun) -> None:
    page = (Path(__file__).parents[3] / "docs" / "logs.md").read_text()
    lines = re.findall(r"^    dxlrun logs (.+)$", page, re.MULTILINE)
    assert len(lines) == 5
    for line in lines:
        place, *words = shlex.split(line)
        assert place == "logs"
        if "--cluster" not in words:
            assert dxlrun("logs", known, *words).code == 0, line


def test_the_table_for_people(known: Path, here: object, dxlrun: Dxlrun) -> None:
    said = dxlrun("logs", known)
    assert said.errors == [f"1 other file is in {known}: notes.txt"]
    assert "unreadable" in said.out
    assert "this is no MCAP file" in " ".join(said.out.split())
    assert said.out.rstrip().endswith("5 of 5 logs")
    assert dxlrun("logs", known, "--where", "lost > 5").out.strip() == "0 of 5 logs"


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--where", "wrst > 3"), 'Referenced column "wrst" not found'),
        (("--where", "lost >"), "--where: syntax error"),
        (("--where", "lost > 1; DROP TABLE found"), "--where: "),
        (("--where", "true) TO '/tmp/x'; --"), "--where: "),
        (("--sql", "COPY logs TO 'stolen.csv'"), "--sql: it may only read, in one statement"),
        (("--sql", "SELECT 1; SELECT 2"), "--sql: it may only read, in one statement"),
        (("--sql", "SET lock_configuration = false"), "--sql: it may only read"),
        (("--sql", "DROP VIEW logs"), "--sql: it may only read"),
        (("--sql", ""), "--sql: it may only read"),
        (("--sql", "SELECT * FROM read_csv('notes.txt')"), "Cannot access file"),
        (("--sql", "SELECT * FROM 'notes.txt'"), "--sql: "),
        (("--sql", "SELECT * FROM read_text('/etc/hostname')"), "Cannot access file"),
        (("--sql", "SELECT * FROM glob('/etc/*')"), "Cannot access"),
        (("--sql", "SELECT nothing FROM servos"), "servos has log, bus, servo_id"),
        (("--sort", "lost SIDEWAYS"), "--where or --sort: syntax error"),
        (("--sql", "SELECT 1", "--where", "true"), "--sql is a whole statement"),
        (("--cluster", "there"), "--cluster there is no address with TLS; write it as tls://"),
    ],
)
def test_a_wrong_question_is_one_sentence_and_reads_or_writes_nothing(
    known: Path,
    dxlrun: Dxlrun,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    sentence: str,
) -> None:
    monkeypatch.chdir(known)
    before = sorted(known.rglob("*"))
    said = dxlrun("logs", known, *words)
    assert (said.code, len(said.errors)) == (2, 1), said
    assert sentence in said.errors[0]
    assert "no log at all" not in said.errors[0]
    assert sorted(known.rglob("*")) == before


def test_a_wrong_name_is_answered_with_the_names(known: Path, here: object, dxlrun: Dxlrun) -> None:
    (error,) = dxlrun("logs", known, "--where", "wrst > 3").errors
    for name in ("worst_wake_up_us", "hottest_deg_c", "unreadable"):
        assert name in error


@pytest.mark.parametrize("kind", ["missing", "file", "empty"])
def test_a_directory_without_logs_is_one_sentence(
    tmp_path: Path, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    place = tmp_path / "place"
    if kind == "file":
        place.write_text("")
    elif kind == "empty":
        place.mkdir()
        (place / "notes.txt").touch()
    said = dxlrun("logs", place)
    assert (said.code, len(said.errors)) == (2, 1)
    expected = {"missing": "there is no directory", "file": "`dxlrun analyze`", "empty": "there are no logs"}
    assert expected[kind] in said.errors[0]


def test_without_duckdb_one_sentence_has_the_command(
    season: Path, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dxlrun_analysis.commands.logs.find_spec", lambda name: None)
    said = dxlrun("logs", season)
    assert said.code == 2
    assert said.errors == ["dxlrun: logs needs duckdb and pyarrow, not installed: pip install 'dxlrun[logs]'"]


def test_a_cache_that_cannot_be_written_is_one_sentence(
    season: Path, here: object, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(season / "notes.txt"))
    said = dxlrun("logs", season)
    assert (said.code, len(said.errors)) == (2, 1)
    assert "XDG_CACHE_HOME names another place" in said.errors[0]


@pytest.mark.parametrize("damage", ["flip", "cut", "gone", "sums", "text"])
def test_damaged_tables_are_made_again_and_that_is_said(
    known: Path, here: SimpleNamespace, dxlrun: Dxlrun, damage: str
) -> None:
    first = rows(dxlrun("logs", known, "--json"))
    store = cache.default_directory() / code_version()
    tables = next(place for place in sorted(store.iterdir()) if (place / "cycles.parquet").is_file())
    file = tables / ("sums.json" if damage == "sums" else "cycles.parquet")
    data = file.read_bytes()
    if damage == "gone":
        file.unlink()
    elif damage == "text":
        shutil.rmtree(tables)
        tables.write_text("no directory")
    else:
        middle = len(data) // 2
        flipped = data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]
        file.write_bytes(data[:middle] if damage == "cut" else flipped)
    here.jobs.clear()
    said = dxlrun("logs", known)
    assert said.code == 0
    assert "what the cache had of 1 log was damaged, and was made again" in said.errors
    assert here.jobs
    here.jobs.clear()
    assert rows(dxlrun("logs", known, "--json")) == first
    assert here.jobs == []


def test_tables_of_other_code_are_made_anew_and_removed_when_long_unused(
    season: Path, here: SimpleNamespace, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    dxlrun("logs", season)
    place = cache.default_directory() / code_version()
    assert place.is_dir()
    for module in (cache, conversion):
        monkeypatch.setattr(module, "code_version", lambda: "other")
    monkeypatch.setattr("dxlrun_analysis.season.season.code_version", lambda: "other")
    here.jobs.clear()
    dxlrun("logs", season)
    assert len(here.jobs) == len(NAMES)
    assert place.is_dir()
    os.utime(place / "used", (1, 1))
    dxlrun("logs", season)
    assert not place.exists()


def test_a_log_in_parts_is_one_log(season: Path, here: object, dxlrun: Dxlrun, split_log: Path) -> None:
    shutil.copytree(split_log, season / "torso_1")
    (season / "torso_1" / "notes.txt").touch()
    said = dxlrun("logs", season, "--json")
    row = rows(said)["torso_1"]
    report = analyze_log(split_log)
    assert row["cycles"] == report.periods.records == 100
    assert row["bytes"] == sum(part.stat().st_size for part in split_log.glob("*.mcap"))
    assert json.loads(said.out)["other_files"] == ["notes.txt", "torso_1/notes.txt"]
    assert len(rows(dxlrun("logs", season, "--json"))) == len(NAMES) + 1
    assert list(rows(dxlrun("logs", season / "torso_1", "--json"))) == ["torso_1"]


def test_a_measurement_is_no_run_that_failed(season: Path, here: object, dxlrun: Dxlrun) -> None:
    record = {latency_log.METADATA_NAME: {"settings": "{}"}}
    LogWriter(season / "latency.mcap", LogHeader("latency", (), (), (), 10**6, 0, metadata=record)).close()
    row = rows(dxlrun("logs", season, "--json"))["latency.mcap"]
    assert row["unreadable"] == "a measurement of `dxlrun latency`, not a run; `dxlrun analyze` shows it"
    assert row["good"] is None


def test_processes_give_the_same_tables_and_one_that_dies_costs_its_own_log_only(
    known: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log whose name makes its process end, as too little memory would."""
    (known / "dies.mcap").write_bytes((known / "first.mcap").read_bytes()[:-9])
    shutil.copy(known / "may/third.mcap", known / "zebra.mcap")
    with_them = pool_of(known, monkeypatch)
    found = converted(find_logs(known), tmp_path / "cache" / "dxlrun" / "logs", with_them, lambda *_: None)
    assert found.problems == {
        "dies.mcap": "the process that read it ended: it crashed, or had too little memory"
    }
    assert sorted(found.tables) == sorted([*NAMES, "zebra.mcap"])


def pool_of(season: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], AbstractContextManager[Executor]]:
    """Processes of which the one that reads dies.mcap ends."""
    (season.parent / "deadly.py").write_text(
        "import os\n"
        "from dxlrun_analysis.season.conversion import convert as true_convert\n"
        "def convert(job):\n"
        "    if job.log.endswith('dies.mcap'):\n"
        "        os._exit(9)\n"
        "    return true_convert(job)\n"
    )
    monkeypatch.syspath_prepend(str(season.parent))
    import deadly

    monkeypatch.setattr("dxlrun_analysis.season.season.convert", deadly.convert)
    return lambda: processes(1)


LOGS = int(os.environ.get("DXLRUN_SEASON_LOGS", "3"))
"""Logs of the campaign, which has 200."""


@pytest.mark.campaign
@pytest.mark.timeout(1200)
def test_a_cluster_of_two_workers_gives_the_same_rows(  # noqa: PLR0917  fixtures
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    dxlrun: Dxlrun,
    here: SimpleNamespace,
    certificate: Path,
) -> None:
    """The campaign's workers are processes and its logs differ in content; it prints how long it took."""
    monkeypatch.setattr(cache, "_SETTLED_NS", 0)
    season = tmp_path / "season"
    season.mkdir()
    few = LOGS < 20
    for number in range(LOGS):
        log = season / f"{number:03}.mcap"
        if few:
            shutil.copy(sorted(made.rglob("*.mcap"))[number], log)
        else:
            simulated_robot(ROBOTS / "bioloid_torso.yaml", duration_s=2 + number / 50, log=log).run()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "here"))
    took = []
    for _ in range(2):
        begin = time.monotonic()
        alone = rows(dxlrun("logs", season, "--json"))
        took.append(time.monotonic() - begin)
    assert len(here.jobs) == LOGS

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "there"))
    # `processes=not few`: threads that are reached by TCP take what a worker takes, and start at once
    tls = ("ca-file", "scheduler.cert", "worker.cert", "client.cert")
    with (
        dask.config.set({f"distributed.comm.tls.{name}": str(certificate) for name in tls}),
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=not few,
            protocol="tls://",
            security=Security(),
            host="127.0.0.1",
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        ) as cluster,
    ):
        address = cluster.scheduler_address
        for _ in range(2):
            begin = time.monotonic()
            there = rows(dxlrun("logs", season, "--json", "--cluster", address))
            took.append(time.monotonic() - begin)
    assert there == alone
    assert len(there) == LOGS == len(here.jobs)
    print(LOGS, "logs: in this process, again, on a cluster, again, s:", *(f"{one:.2f}" for one in took))


def test_a_cluster_without_certificates_is_one_sentence(known: Path, dxlrun: Dxlrun) -> None:
    (known / "new.mcap").write_bytes(b"something new")
    said = dxlrun("logs", known, "--cluster", "tls://127.0.0.1:1")
    assert (said.code, len(said.errors)) == (1, 1)
    assert "--cluster tls://127.0.0.1:1 needs certificates" in said.errors[0]


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (Converted(problem="other", other_code=True), "has other code of dxlrun; install the same there"),
        (Converted("0123"), "were written where this machine does not see them"),
    ],
)
def test_a_cluster_of_other_code_or_without_the_cache_is_one_sentence(
    season: Path,
    dxlrun: Dxlrun,
    monkeypatch: pytest.MonkeyPatch,
    result: Converted,
    sentence: str,
) -> None:
    monkeypatch.setattr("dxlrun_analysis.season.season.convert", lambda job: result)
    said = dxlrun("logs", season)
    assert (said.code, len(said.errors)) == (1, 1)
    assert sentence in said.errors[0]


def test_a_fault_of_the_conversion_hides_no_other_log(
    known: Path, here: object, dxlrun: Dxlrun, monkeypatch: pytest.MonkeyPatch
) -> None:
    def convert(job: object) -> None:
        raise ArithmeticError("a strange log")

    monkeypatch.setattr("dxlrun_analysis.season.season.convert", convert)
    shutil.copytree(known / "may", known / "june")
    found = rows(dxlrun("logs", known, "--json"))
    assert found["june/third.mcap"]["unreadable"] == "internal error: ArithmeticError: a strange log"
