"""`--ledger` of a run on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.judges import log_has_every_byte

from dxlrun.log.log_reader import read_log
from dxlsim.bus.ledger import read_ledger


@pytest.mark.parametrize("virtual", [True, False])
@pytest.mark.usefixtures("reader")
def test_the_log_of_a_run_is_what_its_buses_saw(dxlrun: Callable, torso: Path, *, virtual: bool):
    dxlrun(torso, "--duration", "0.3", "--ledger", "seen.jsonl", *(["--virtual"] if virtual else []))
    (log,) = Path("logs").iterdir()  # no ledger beside the log
    log_has_every_byte(read_log(log), read_ledger(Path("seen.jsonl")))
