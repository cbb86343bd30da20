"""`dxlrun upload` and tables of a store: whole logs only, none twice, none over another, and no log read."""

import os
import shutil
import socket
from pathlib import Path

import fsspec
import pytest
from msgspec.structs import replace
from tests.kit.answers import result_of
from tests.kit.commands import Dxlrun
from tests.kit.held_logs import being_written

from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of, simulated_robot
from dxlrun_analysis.season import season_runs
from dxlrun_analysis.season import store as stores

pytestmark = pytest.mark.long

JOINT = Path(__file__).parents[3] / "robots" / "single_joint.yaml"
NAMES = ["may/second.mcap", "one.mcap", "parts"]


def old(directory: Path) -> Path:
    """Let all files of a directory have been there for long."""
    for path in directory.rglob("*.mcap"):
        os.utime(path, (1e9, 1e9))
    return directory


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two logs and one in two parts, the second of which ends well before its time."""
    directory = tmp_path_factory.mktemp("made")
    (directory / "may").mkdir()
    simulated_robot(JOINT, duration_s=0.3, log=directory / "one.mcap").run()
    simulated_robot(JOINT, duration_s=0.2, log=directory / "may" / "second.mcap").run()
    plan = replace(plan_of(JOINT, duration_s=1.5), recording=RecordingPlan(split_ns=10**9))
    VirtualRobot(plan, log=directory / "parts").run()
    return old(directory)


@pytest.fixture
def logs(made, tmp_path, monkeypatch):
    """The same in a directory of the test, which keeps its tables there too; this process reads the logs."""
    monkeypatch.setattr(
        season_runs, "_together", lambda logs, *_: {log.name: season_runs.row_of(log) for log in logs}
    )
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(made, tmp_path / "logs"))


@pytest.fixture
def there(tmp_path):
    """The directory of a store."""
    return tmp_path / "there"


def told(dxlrun: Dxlrun, logs: Path, url: str, code: int = 0) -> dict[str, list[str]]:
    """Upload; return what became of each log, without what is empty."""
    said = dxlrun("upload", logs, url, "--json")
    assert said.code == code, said
    return {key: names for key, names in result_of(said.out).items() if names}


def rows(dxlrun: Dxlrun, place: object) -> tuple[list[dict[str, object]], int]:
    """Return the table of a place, and how many rows were read for it."""
    said = dxlrun("logs", place, "--json")
    assert said.code == 0, said
    found = result_of(said.out)
    return found["rows"], found["converted"]


def report(dxlrun: Dxlrun, log: object) -> dict[str, object]:
    """Return the analysis of a log, without its place."""
    return result_of(dxlrun("analyze", log, "--json").out) | {"log": ""}


def test_a_store_has_the_table_of_its_directory_without_a_byte_of_a_log(logs, there, dxlrun, monkeypatch):
    url, (expected, _) = f"file://{there}", rows(dxlrun, logs)

    assert told(dxlrun, logs, url) == {"uploaded": NAMES}
    for path in logs.rglob("*.mcap"):
        assert (there / path.relative_to(logs)).read_bytes() == path.read_bytes()
    for path in there.rglob("*.mcap"):
        path.write_bytes(b"")
    (there / "notes.txt").touch()
    assert rows(dxlrun, url) == (expected, 3)
    assert rows(dxlrun, url) == (expected, 0)
    assert dxlrun("logs", url).errors == [f"1 other file is in {url}: notes.txt"]
    assert told(dxlrun, logs, url) == {"there": NAMES}

    shutil.copytree(logs, there, dirs_exist_ok=True)
    for name in ("one.mcap", "parts"):
        assert report(dxlrun, f"{url}/{name}") == report(dxlrun, logs / name)


def test_an_upload_that_ends_anywhere_goes_on_and_never_shows_half_a_log(logs, there, dxlrun, monkeypatch):
    """Each call of the store fails once; nothing is a row before it is there as a whole."""
    shutil.rmtree(logs / "may")
    url, (expected, _) = f"file://{there}", rows(dxlrun, logs)
    files = type(fsspec.filesystem("file"))
    calls, left = 0, 0

    def failing(name: str) -> None:
        true = getattr(files, name)

        def call(self: object, *given: object, **options: object) -> object:
            nonlocal left
            if left == 0:
                if name == "put_file":  # half of it is there, as no store of S3 would have it
                    Path(str(given[1])).parent.mkdir(parents=True, exist_ok=True)
                    Path(str(given[1])).write_bytes(Path(str(given[0])).read_bytes()[:100])
                raise ConnectionError("the network is gone")
            left -= 1
            return true(self, *given, **options)

        monkeypatch.setattr(files, name, call)

    for name in ("put_file", "pipe_file"):
        failing(name)
    while True:
        left = calls
        said = dxlrun("upload", logs, url)
        found, _ = rows(dxlrun, url)
        whole = [row for row in found if not row["unreadable"]]
        assert all(row in expected for row in whole)
        if said.code == 0:
            break
        assert (said.code, said.errors) == (1, [f"dxlrun: {url}: the network is gone"])
        left = -1
        again = told(dxlrun, logs, url)
        assert len(again.get("there", ())) == len(whole)
        assert rows(dxlrun, url)[0] == expected
        shutil.rmtree(there)
        calls += 1
    assert calls == 5  # three files and two rows


def test_what_a_robot_writes_still_waits_and_no_other_run_is_written_over(logs, there, dxlrun):
    url = f"file://{there}"
    with being_written(logs / "one.mcap"):
        assert told(dxlrun, logs, url) == {"uploaded": ["may/second.mcap", "parts"], "written": ["one.mcap"]}

    shutil.copy(logs / "one.mcap", logs / "may" / "second.mcap")  # of another run
    old(logs)
    before = (there / "may/second.mcap").read_bytes()
    found = {"uploaded": ["one.mcap"], "there": ["parts"], "others": ["may/second.mcap"]}
    assert told(dxlrun, logs, url, code=1) == found
    assert (there / "may/second.mcap").read_bytes() == before
    assert "a different run named may/second.mcap" in dxlrun("upload", logs, url).errors[0]

    (there / "one.mcap.run.json").write_text('{"cycles": "many"}')
    assert rows(dxlrun, url)[0][1]["unreadable"] == stores.DAMAGED
    (there / "parts.run.json").unlink()
    assert rows(dxlrun, url)[0][2]["unreadable"] == stores.UNFINISHED
    again = told(dxlrun, logs, url, code=1)
    assert again == {"uploaded": ["one.mcap", "parts"], "others": ["may/second.mcap"]}
    row = there / "one.mcap.run.json"
    row.write_text(row.read_text().replace('"began":null', '"began":"2026-11-24T09:00:00"'))
    assert "one.mcap" in told(dxlrun, logs, url, code=1)["others"]
    row.write_text(row.read_text().replace('"2026-', '"2025-'))  # of the same size
    assert rows(dxlrun, url)[0][1]["began"] == "2025-11-24T09:00:00"


def test_a_log_that_grows_while_it_is_copied_has_no_row(logs, there, dxlrun, monkeypatch):
    files, url = type(fsspec.filesystem("file")), f"file://{there}"
    true = files.put_file

    def put_file(self: object, path: str, to: str) -> None:
        with Path(path).open("ab") as log:
            log.write(b"more")
        true(self, path, to)

    monkeypatch.setattr(files, "put_file", put_file)
    assert told(dxlrun, logs, url) == {"written": NAMES}
    monkeypatch.undo()
    assert list(there.rglob("*.json")) == []


@pytest.fixture
def bucket(monkeypatch):
    """The URL of a bucket on a server that speaks S3."""
    pytest.importorskip("s3fs", reason="needs dxlrun[store]")
    server = pytest.importorskip("moto.server", reason="needs moto[server,s3], a server of S3")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    running = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir("s3://lab")
    yield "s3://lab/torso"
    running.stop()


def test_a_server_of_s3(logs, dxlrun, bucket, monkeypatch):
    expected, _ = rows(dxlrun, logs)
    assert told(dxlrun, logs, bucket) == {"uploaded": NAMES}
    assert told(dxlrun, logs, bucket) == {"there": NAMES}
    assert rows(dxlrun, bucket) == (expected, 0)
    for name in ("one.mcap", "parts"):
        assert report(dxlrun, f"{bucket}/{name}") == report(dxlrun, logs / name)
    said = dxlrun("upload", logs, "s3://nowhere/torso")
    assert (said.code, len(said.errors)) == (1, 1)
    assert "bucket does not exist" in said.errors[0]
    with socket.create_server(("127.0.0.1", 0)) as closed:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{closed.getsockname()[1]}")
    said = dxlrun("logs", bucket)
    assert (said.code, len(said.errors)) == (1, 1)
    assert "Could not connect" in said.errors[0]
