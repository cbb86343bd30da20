"""The face of the package: complete, and light."""

import subprocess
import sys

import pytest
from tests.kit.awaited import DEADLINE_S

import dxlrun


def test_every_name_is_there():
    assert len(dxlrun.__all__) > 30
    for name in dxlrun.__all__:
        assert getattr(dxlrun, name) is not None
    assert set(dxlrun.__all__) <= set(dir(dxlrun))


@pytest.mark.parametrize("module", ["dxlrun", "dxlrun.control.realtime_grants"])
def test_importing_it_loads_neither_numpy_nor_pydantic(module):
    script = f"import sys, {module}; print([m for m in ('numpy', 'pydantic', 'pluggy') if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=DEADLINE_S
    )
    assert done.stdout.strip() == "[]"
