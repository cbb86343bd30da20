"""Entry point of `dxlrun view`. Its import fails with InputError if dxlrun has another version."""

from __future__ import annotations

from dxlrun import InputError
from dxlrun_view.versions import other_version

if (wrong := other_version()) is not None:
    raise InputError(wrong)

from dxlrun_view.view import view

__all__ = ["view"]
