"""The face of dxlwire: its names, its examples, and that nothing of the runtime is needed."""

from __future__ import annotations

import ast
import doctest
import subprocess
import sys
from pathlib import Path

import pytest

import dxlwire

README = Path(dxlwire.__file__).with_name("README.md")
OWN = Path(__file__).parent
KIT = [OWN.parent / f"kit/{name}.py" for name in ("cases", "exchanges", "plans")]


def test_every_public_name_exists() -> None:
    assert dxlwire.__all__
    for name in dxlwire.__all__:
        assert getattr(dxlwire, name) is not None
    assert set(dxlwire.__all__) <= set(dir(dxlwire))
    with pytest.raises(AttributeError, match="has no attribute 'robots'"):
        dxlwire.robots  # noqa: B018  the access is what raises


def test_examples_of_docstring_and_readme_are_right() -> None:
    assert doctest.testmod(dxlwire).failed == 0
    result = doctest.testfile(str(README), module_relative=False)
    assert result.failed == 0
    assert result.attempted > 5


def test_import_loads_neither_numpy_nor_dxlrun() -> None:
    code = """
import sys, dxlwire
assert not {"numpy", "msgspec"} & set(sys.modules)
for name in dxlwire.__all__:
    getattr(dxlwire, name)
import dxlwire.exchange.kernel, dxlwire.exchange.idle, dxlwire.plan.planning, dxlwire.port.reopening
print(sorted(name for name in sys.modules if name.split(".")[0] in ("dxlrun", "dxlsim", "pydantic")))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


def test_tests_of_dxlwire_need_neither_runtime_nor_simulation() -> None:
    found: dict[str, set[str]] = {}
    for path in (*OWN.rglob("*.py"), *KIT):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {one.name for one in node.names}
            else:
                names = {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            found.setdefault(path.name, set()).update(names)
    own = {name for names in found.values() for name in names if name.split(".")[0] in ("dxlrun", "dxlsim")}
    assert own == set()
    kit = {name for names in found.values() for name in names if name.startswith("tests.")}
    assert kit == {"tests.kit.awaited", "tests.kit.cases", "tests.kit.exchanges", "tests.kit.plans"}
