"""Single files: controllers of a file of Python beside the robot file, `type: ./wave.py:Wave`.

The text is read once, when the robot is compiled, and is part of the plan: every process of the run, and a
replay, executes that text, whatever became of the file.
"""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from functools import cache
from hashlib import sha256
from importlib.abc import ExecutionLoader
from types import ModuleType

from msgspec.structs import replace

from dxlrun.contract.controller import Controller
from dxlrun.errors import PlugInError, suggestion
from dxlrun.plan.loop_plan import ControllerPlan

_TYPE = re.compile(r"\./([A-Za-z_]\w*\.py):([A-Za-z_]\w*)", re.ASCII)
_HASH = 12
"""Digits of a SHA-256 that tell one version of a file from another; the log has all of them."""


def is_of_file(type_name: str) -> bool:
    """Return whether a type is meant to be a class of a file, however it is written."""
    return "/" in type_name or ".py" in type_name


def file_of(type_name: str) -> str | None:
    """Return the name of the file of a type, `wave.py` of `./wave.py:Wave`; None: it is not written so."""
    match = _TYPE.fullmatch(type_name)
    return match and match[1]


def publisher_of(file: str, text: str) -> str:
    """Return a file's name with its hash, as packages are named with their version."""
    return f"{file} {sha256(text.encode()).hexdigest()[:_HASH]}"


def published_by(
    controllers: Sequence[ControllerPlan], texts: Mapping[str, str]
) -> tuple[ControllerPlan, ...]:
    """Return the plans of controllers; those of files in `texts` are published by these texts.

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
    """Return the class of a type from the files' texts, by name.

    Raises KeyError where no file has it, PlugInError with the file's line where it cannot be executed.
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


class _Text(ExecutionLoader):
    """Loads a module from a text; tracebacks show the file's name."""

    def __init__(self, file: str, text: str) -> None:
        self._file, self._text = file, text

    def get_filename(self, fullname: str) -> str:
        """Return the name of the file."""
        return self._file

    def get_source(self, fullname: str) -> str:
        """Return the text, for tracebacks too."""
        return self._text


@cache
def _executed(file: str, text: str) -> ModuleType:
    """Return a file as a module, executed once in a process."""
    loader = _Text(file, text)
    module = ModuleType(publisher_of(file, text).replace(".py ", "_"))
    module.__loader__ = loader
    sys.modules[module.__name__] = module  # where annotations look for their names
    try:
        loader.exec_module(module)
    except (Exception, SystemExit) as error:
        what = " ".join((error.msg if isinstance(error, SyntaxError) else str(error)).split())
        raise PlugInError(f"{file}:{_line_of(error, file)}: {type(error).__name__}: {what}") from error
    return module


def _line_of(error: BaseException, file: str) -> int:
    """Return the line of a file at which it could not go on."""
    if isinstance(error, SyntaxError) and error.filename == file:
        return error.lineno or 1
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return lines[-1] or 1 if lines else 1
