"""Packages of strangers, installed as pip would leave them."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dxlrun import installed_plugins

Install = Callable[..., Path]


def plugin_folder(
    folder: Path, module: str, source: str, distribution: str, *, version: str = "1.0", entry: str = ""
) -> Path:
    """Write a plug-in of one module into a folder; `entry`: name of its entry point, if not the module's."""
    (folder / f"{module}.py").write_text(source)
    info = folder / f"{distribution.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[dxlrun]\n{entry or module} = {module}\n")
    installed_plugins._read.cache_clear()
    return folder


@contextmanager
def installing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Give what installs a distribution with one plug-in; its modules are forgotten at the end."""
    monkeypatch.syspath_prepend(folder)
    modules = set(sys.modules)

    def install(distribution: str, module: str, source: str, version: str = "2.5") -> Path:
        return plugin_folder(folder, module, source, distribution, version=version, entry=f"{module}_entry")

    yield install
    installed_plugins._read.cache_clear()
    for name in set(sys.modules) - modules:
        if str(folder) in str(getattr(sys.modules[name], "__file__", None)):
            del sys.modules[name]
