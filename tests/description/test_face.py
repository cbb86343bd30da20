# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import subprocess
import sys

import pytest

import dxlrun.description


def test_every_name_of_the_face_is_there() -> None:
    for name in dxlrun.description.__all__:
        assert getattr(dxlrun.description, name) is not None


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nothing_like_it"):
        dxlrun.description.nothing_like_it  # noqa: B018 (reading it is the test)


def test_units_load_neither_yaml_nor_the_models() -> None:
    # the loop's process needs units only, and each import is memory that it locks
    code = "import sys, dxlrun.description; dxlrun.description.units; print([m for m in ('yaml', 'dxlrun.description.robot') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
