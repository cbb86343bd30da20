"""The command of the exchange benchmark: its words, and its results as a table and as JSON."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from exchange import hosts
from exchange.command import main

pytestmark = pytest.mark.long

FEW = ("--servos", "1", "--protocol", "2.0", "--seconds", "0.05")
FOLDER = Path(__file__).parents[2] / "bench" / "exchange"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("--peers", "ours,theirs"),
            "--peers: there is no theirs; there are ours, polled, unrecorded, bus",
        ),
        (("--peers", ""), "--peers is empty; there are ours"),
        (("--protocol", "3.0"), "--protocol: there is no 3.0; there are 1.0, 2.0"),
        (("--against", "nothing"), "--against: there is no nothing; there are canned, simulated"),
        (("--servos", "1,many"), "--servos 1,many: give numbers from 1 to 50, for example 1,8,20"),
        (("--servos", "51"), "--servos 51: give numbers from 1 to 50"),
        (("--seconds", "0"), "--seconds 0: give from 0.01 to 3600"),
        (("--baud", "0"), "--baud 0: give from 9600 to 4500000"),
    ],
)
def test_a_wrong_word_is_refused_and_nothing_is_measured(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...], sentence: str
) -> None:
    assert main(words) == 2
    printed = capsys.readouterr()
    assert sentence in printed.err
    assert printed.out == ""


def test_the_folder_is_run_as_a_program_from_anywhere_and_prints_json(tmp_path: Path) -> None:
    words = (*FEW, "--peers", "unrecorded", "--json")
    ran = subprocess.run(
        [sys.executable, FOLDER, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
    (case,) = json.loads(ran.stdout)["cases"]
    assert (case["protocol"], case["servos"], case["against"]) == (2.0, 1, "canned")
    assert case["hosts"][0]["host"] == "unrecorded"
    assert case["hosts"][0]["exchanges"] > 0


def test_a_host_that_is_not_installed_is_named_with_the_command_that_installs_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = hosts.find_spec
    monkeypatch.setattr(hosts, "find_spec", lambda name: None if name == "rustypot" else found(name))
    assert main([*FEW, "--peers", "unrecorded,rustypot"]) == 0
    printed = capsys.readouterr()
    assert "rustypot is not installed and was left out; `pip install '.[test]'` installs it" in printed.err
    assert "rustypot" not in printed.out
