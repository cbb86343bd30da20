"""`dxlrun bench`: its words, and its results as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dxlrun.bench import hosts, rate

FEW = ("--servos", "1", "--protocol", "2.0", "--seconds", "0.05")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("--peers", "ours,theirs"),
            "--peers: there is no theirs; there are ours, polled, unrecorded, sdk",
        ),
        (("--peers", ""), "--peers says nothing; there are ours"),
        (("--protocol", "3.0"), "--protocol: there is no 3.0; there are 1.0, 2.0"),
        (("--against", "nothing"), "--against: there is no nothing; there are canned, simulated"),
        (("--servos", "1,many"), "--servos 1,many: give numbers from 1 to 50, for example 1,8,20"),
        (("--servos", "51"), "--servos 51: give numbers from 1 to 50"),
        (("--seconds", "0"), "--seconds 0: give from 0.01 to 3600"),
        (("--baud", "0"), "--baud 0: give from 9600 to 4500000"),
    ],
)
def test_a_wrong_word_is_told_and_nothing_is_measured(
    dxlrun: Callable[..., Any], words: tuple[str, ...], sentence: str
) -> None:
    said = dxlrun("bench", "bus", *words)
    assert said.code == 2
    assert sentence in said.err


def test_the_exchange_is_told_in_a_table(dxlrun: Callable[..., Any]) -> None:
    said = dxlrun("bench", "bus", *FEW, "--peers", "unrecorded,rustypot")
    assert said.code == 0
    head, first, second = said.out.splitlines()
    assert head.split()[:4] == ["against", "protocol", "servos", "host"]
    assert first.split()[:6] == ["canned", "2.0", "1", "x", "XM430-W350", "unrecorded"]
    assert "of it" in second


def test_the_exchange_is_told_as_json(dxlrun: Callable[..., Any]) -> None:
    said = dxlrun("bench", "bus", *FEW, "--peers", "unrecorded", "--json")
    (case,) = json.loads(said.out)["cases"]
    assert (case["protocol"], case["servos"], case["against"]) == (2.0, 1, "canned")
    assert case["hosts"][0]["host"] == "unrecorded"
    assert case["hosts"][0]["exchanges"] > 0


def test_who_is_not_installed_is_said_with_the_command_that_installs_it(
    dxlrun: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = hosts.find_spec
    monkeypatch.setattr(hosts, "find_spec", lambda name: None if name == "rustypot" else found(name))
    said = dxlrun("bench", "bus", *FEW, "--peers", "unrecorded,rustypot")
    assert said.code == 0
    assert "rustypot is not installed and was left out; `pip install 'dxlrun[bench]'` installs it" in said.err
    assert "rustypot" not in said.out


def test_a_robot_file_that_is_not_there_is_told(dxlrun: Callable[..., Any], tmp_path: Path) -> None:
    said = dxlrun("bench", "rate", tmp_path / "none.yaml")
    assert said.code == 2
    assert "there is no robot file" in said.err


def test_a_robot_is_run_to_see_whether_a_rate_is_kept(
    dxlrun: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rate, "MOST_TRIES", 1)  # each takes seconds
    robot = Path(__file__).parents[2] / "robots" / "single_joint.yaml"
    said = dxlrun("bench", "rate", robot, "--seconds", "0.3", "--json")
    told = json.loads(said.out)
    assert said.code == (0 if told["kept_hz"] else 1)
    assert told["robot"] == "single_joint"
    assert told["tries"][0]["rate_hz"] <= told["computed_hz"]
    assert told["kept_hz"] in (None, told["tries"][-1]["rate_hz"])
