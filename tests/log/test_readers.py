"""Other programs open a log without a warning, whole, cut and split; pymcap-cli is a program (GPL)."""

import json
import os
import subprocess
import sys
import warnings
from collections import Counter
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from tests.kit.awaited import DEADLINE_S
from tests.kit.decoded import decode_log

from dxlrun.log.log_reader import open_log

pytestmark = pytest.mark.long

PYMCAP = """
import sys
from importlib.metadata import entry_points
sys.argv[0] = "pymcap-cli"
(script,) = entry_points(group="console_scripts", name="pymcap-cli")
sys.exit(script.load()())
"""
ONLY_311 = "in the extra `test` on Python 3.11 only"


@pytest.fixture
def logs(torso):
    """A whole log with topics of controllers, and two parts of a split one."""
    return [torso / "whole.mcap", *sorted((torso / "parts").iterdir())[1:]]


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        env=environment,
        check=False,
    )


def counted(path: Path) -> dict[str, int | None]:
    return {name: topic.count for name, topic in open_log(path).topics.items() if topic.count}


def test_rosbags_opens_it_as_a_bag_and_takes_each_message_by_its_definition(logs):
    """Packed again it is the same bytes, and the hash of the definition is that of the channel."""
    for path in logs:
        counts = Counter[str]()
        with warnings.catch_warnings(), AnyReader([path]) as reader:
            warnings.simplefilter("error")
            for connection, _, data in reader.messages():
                kind, store = connection.msgtype, reader.typestore
                assert bytes(store.serialize_cdr(reader.deserialize(data, kind), kind)) == data
                counts[connection.topic] += 1
            hashes = {one.topic: store.hash_rihs01(one.msgtype) for one in reader.connections}
        assert counts == counted(path)
        declared = {one.topic: one.channel.metadata["topic_type_hash"] for one in decode_log(path)}
        assert declared.items() <= hashes.items()
        assert declared.keys() == counts.keys()


def test_the_doctor_finds_nothing_but_what_is_wrong(logs, tmp_path):
    pytest.importorskip("pymcap_cli", reason=ONLY_311)
    for path in logs[::2]:
        done = run("-c", PYMCAP, "doctor", "--format", "jsonl", path)
        found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        assert done.returncode == 0, done.stdout + done.stderr
        assert found
        assert {one.get("severity", "info") for one in found} == {"info"}, done.stdout
    (tmp_path / "cut.mcap").write_bytes(logs[0].read_bytes()[:-100])
    assert run("-c", PYMCAP, "doctor", tmp_path / "cut.mcap").returncode != 0


def test_rerun_checks_and_converts_it_without_a_warning(logs, tmp_path):
    pytest.importorskip("rerun", reason=ONLY_311)
    for path in logs[::2]:
        converted = tmp_path / f"{path.stem}.rrd"
        for words in (("check", path), ("convert", path, "-o", converted, "--application-id", "run")):
            done = run("-m", "rerun", "mcap", *words)
            text = done.stdout + done.stderr
            assert done.returncode == 0, text
            assert "WARN" not in text, text
            assert "ERROR" not in text, text
        assert converted.stat().st_size > 10_000
