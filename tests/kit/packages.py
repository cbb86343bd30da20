"""Packages of strangers, installed as pip would leave them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dxlrun import installed_plugins

Install = Callable[..., None]


@contextmanager
def installing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Give what installs a distribution with one plug-in; its modules are forgotten at the end."""
    monkeypatch.syspath_prepend(folder)
    modules = set(sys.modules)

    def install(distribution: str, module: str, source: str, version: str = "2.5") -> None:
        (folder / f"{module}.py").write_text(source)
        info = folder / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(f"[dxlrun]\n{module}_entry = {module}\n")
        installed_plugins._read.cache_clear()

    yield install
    installed_plugins._read.cache_clear()
    for name in set(sys.modules) - modules:
        if str(folder) in str(getattr(sys.modules[name], "__file__", None)):
            del sys.modules[name]
