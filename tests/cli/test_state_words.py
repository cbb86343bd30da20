"""A state has one word in every output: a joint without torque is `limp`."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from dxlrun.channels.cycle import Torque

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]


def test_joint_without_torque_is_limp_whatever_the_reason() -> None:
    assert [torque.word for torque in Torque] == [
        *("unknown", "on", "doubt", "limp", "limp", "lost", "rebooting", "given")
    ]


def test_page_has_the_words_of_the_states() -> None:
    text = (ROOT / "plugins/dxlrun_view/page/state.js").read_text()
    (words,) = re.findall(r"const TORQUE = (\[.+?\]);", text)
    assert json.loads(words) == [torque.word for torque in Torque]
