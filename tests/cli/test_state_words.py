"""A state has one word in every output: a joint without torque is `limp`."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

from dxlrun.channels.cycle import Torque

ROOT = Path(__file__).parents[2]
OTHER_WORDS = re.compile(
    r"\b(has|have|holds) no torque\b(?! (limit|or current mode))|\bjoints? without torque\b"
)


def _messages(file: Path) -> Iterator[str]:
    """Yield the texts of a module, without docstrings."""
    for node in ast.walk(ast.parse(file.read_text())):
        for child in () if isinstance(node, ast.Expr) else ast.iter_child_nodes(node):
            if isinstance(child, ast.Constant) and isinstance(child.value, str):
                yield child.value


def test_joint_without_torque_is_limp_whatever_the_reason() -> None:
    assert [torque.word for torque in Torque] == [
        *("unknown", "on", "doubt", "limp", "limp", "lost", "rebooting", "given")
    ]


def test_page_has_the_words_of_the_states() -> None:
    text = (ROOT / "plugins/dxlrun_view/page/state.js").read_text()
    (words,) = re.findall(r"const TORQUE = (\[.+?\]);", text)
    assert json.loads(words) == [torque.word for torque in Torque]


def test_no_message_calls_a_limp_joint_otherwise() -> None:
    files = [file for room in ("runtime", "plugins") for file in (ROOT / room).rglob("*.py")]
    assert len(files) > 100
    found = [
        (str(file.relative_to(ROOT)), text)
        for file in files
        for text in _messages(file)
        if OTHER_WORDS.search(text)
    ]
    assert not found
