"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

Flag = Annotated[bool, Parameter(negative=(), show_default=False)]
"""An option without a value."""
JsonFlag = Annotated[bool, Parameter(name="--json", negative=(), show_default=False)]
"""`--json`."""
Motions = Annotated[tuple[Path, ...], Parameter(negative=(), show_default=False)]
"""A motion file; the option may be given several times."""
