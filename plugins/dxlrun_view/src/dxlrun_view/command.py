"""Entry point of the verb `view`. It checks that the versions of dxlrun and this package match."""

from __future__ import annotations

from dxlrun import InputError
from dxlrun_view.versions import other_version

if (wrong := other_version()) is not None:
    raise InputError(wrong)

from dxlrun_view.view import view

__all__ = ["view"]
