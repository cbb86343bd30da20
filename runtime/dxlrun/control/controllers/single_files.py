"""Single files: controllers in a Python file next to the robot file, `type: ./wave.py:Wave`.

The text is read once, when the robot is compiled, and is part of the plan. All processes of the run and a
replay execute that text, even if the file has changed.
"""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.abc import ExecutionLoader
from pathlib import Path
from types import ModuleType

from msgspec.structs import replace

from dxlrun.contract.controller import Controller
from dxlrun.errors import PlugInError, suggestion
from dxlrun.plan.loop_plan import ControllerPlan

_TYPE = re.compile(r"\./([A-Za-z_]\w*\.py):([A-Za-z_]\w*)", re.ASCII)
_HASH = 12
"""Number of SHA-256 digits in the names of file versions; the log has all 64 digits."""


def is_of_file(type_name: str) -> bool:
    """Return whether a controller's `type` refers to a Python file, even if misspelled."""
    return "/" in type_name or ".py" in type_name


def file_of(type_name: str) -> str | None:
    """Return the file name in a controller's `type`:

    `wave.py` for `./wave.py:Wave`; None for another form.
    """
    match = _TYPE.fullmatch(type_name)
    return match and match[1]


def class_beside(folder: Path, type_name: str) -> str:
    """Return the `type` that is meant by the name of a class in a Python file of a folder, such as `Wave` or
    `wave.Wave`; empty if no file has this class.
    """
    name = re.split(r"\W", type_name)[-1]
    for path in sorted(folder.glob("*.py")) if name else ():
        with suppress(OSError):
            if re.search(rf"^class {name}\b", path.read_text("utf-8", "replace"), re.MULTILINE):
                return f"./{path.name}:{name}"
    return ""


def publisher_of(file: str, text: str) -> str:
    """Return the file name with the hash of its text, used in place of a package name with its version."""
    return f"{file} {sha256(text.encode()).hexdigest()[:_HASH]}"


def published_by(
    controllers: Sequence[ControllerPlan], texts: Mapping[str, str]
) -> tuple[ControllerPlan, ...]:
    """Return the plans; those of controllers in single files get `distribution` set to file name and hash.

    Args:
        controllers: The plans of all controllers.
        texts: Texts of single files by name.
    """
    return tuple(
        replace(plan, distribution=publisher_of(file, texts[file]))
        if (file := file_of(plan.type)) in texts and file is not None
        else plan
        for plan in controllers
    )


def class_in_file(type_name: str, files: Mapping[str, str]) -> object:
    """Execute the text of a single file, and return the class that a controller's `type` names.

    Args:
        type_name: `./wave.py:Wave`.
        files: Texts by file name.

    Raises:
        KeyError: The type does not refer to one of the files.
        PlugInError: The text has no such class, or cannot be executed; the message has the line.
    """
    file = file_of(type_name)
    if file is None:
        raise KeyError(type_name)
    module = _executed(file, files[file])
    name = type_name.rpartition(":")[2]
    found: object = getattr(module, name, None)
    if found is None:
        kinds = (
            one for one in vars(module).values() if isinstance(one, type) and issubclass(one, Controller)
        )
        known = [one.__name__ for one in kinds if one.__module__ == module.__name__]
        raise PlugInError(f"{file} has no class {name}; {suggestion(name, known)}")
    return found


class _TextLoader(ExecutionLoader):
    """Module loader that executes the text of a single file, so that tracebacks show the file's name."""

    def __init__(self, file: str, text: str) -> None:
        self._file, self._text = file, text

    def get_filename(self, fullname: str) -> str:
        """Return the name of the single file, without a folder."""
        return self._file

    def get_source(self, fullname: str) -> str:
        """Return the text of the single file, which is executed and shown in tracebacks."""
        return self._text


@cache
def _executed(file: str, text: str) -> ModuleType:
    """Execute the text of a single file, once a process, and return the module."""
    loader = _TextLoader(file, text)
    module = ModuleType(publisher_of(file, text).replace(".py ", "_"))
    module.__loader__ = loader
    sys.modules[module.__name__] = module  # annotations are resolved in this module
    try:
        loader.exec_module(module)
    except (Exception, SystemExit) as error:
        what = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        raise PlugInError(f"{file}:{_line_of(error, file)}: {type(error).__name__}: {what}") from error
    return module


def _line_of(error: BaseException, file: str) -> int:
    """Return the line of the single file at which its execution failed; 1 if unknown."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return error.lineno or 1
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return lines[-1] or 1 if lines else 1
