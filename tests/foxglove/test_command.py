"""What `dxlrun foxglove` refuses before it listens."""

import os
from pathlib import Path

import pytest

from dxlrun import DxlrunError, InputError
from dxlrun_foxglove.foxglove import foxglove


@pytest.fixture(autouse=True)
def no_robot(tmp_path, monkeypatch):
    """No robot runs; what is refused leaves this process its share of the processor."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    before = os.nice(0)
    yield
    assert os.nice(0) == before


def test_the_network_is_served_with_tls_alone():
    for address in ("10.0.0.1", "192.168.1.2", "::", "localhost"):
        with pytest.raises(InputError, match=r"needs TLS; add --cert"):
            foxglove(listen=address)
    with pytest.raises(InputError, match=r"--key key\.pem has no certificate; add --cert FILE"):
        foxglove(key=Path("key.pem"))


@pytest.mark.needs("foxglove")
def test_a_robot_has_to_run():
    with pytest.raises(DxlrunError, match="no running robot found"):
        foxglove()
