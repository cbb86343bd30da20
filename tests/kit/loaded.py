"""Modules that lie in no package: scripts beside the code."""

import importlib.util
from pathlib import Path
from types import ModuleType


def loaded(path: Path) -> ModuleType:
    """Return a script as a module, of a name of its own."""
    spec = importlib.util.spec_from_file_location(f"{path.stem}_of_dxlrun", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
