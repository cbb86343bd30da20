"""CSV of joint positions: a header with a time and joints, and a row for each moment.

Source: RFC 4180. The header has `time`, `t` or `time_s`, and names of joints; the values are rad, unless
`--unit deg` or a name that ends in `_deg` says otherwise.
"""

from __future__ import annotations

import csv
import io
import math

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions, Mark
from dxlrun_import.checked_values import refused
from dxlrun_import.motion_text import MotionPoint, motion_conversion

_TIMES = ("time", "t", "time_s", "timestamp", "seconds")
_SUFFIXES = {"_deg": math.radians(1), "_rad": 1.0}
_SEPARATORS = ",;\t"


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the rows; the first column of a known name is the time, s, from the first row on."""
    rows = list(csv.reader(io.StringIO(content.text), delimiter=_separator(content.text)))
    header = [name.strip() for name in rows[0]]
    index = next(one for one, name in enumerate(header) if name.lower() in _TIMES)
    scale = math.radians(1) if options.unit == "deg" else 1.0
    columns = []
    for place, name in enumerate(header):
        suffix = next((one for one in _SUFFIXES if name.endswith(one)), "")
        columns += [(place, name.removesuffix(suffix), _SUFFIXES.get(suffix, scale))] * (place != index)
    points: list[MotionPoint] = []
    first = 0.0
    for line, row in enumerate(rows[1:], 2):
        mark = Mark(str(content.path), line, 1)
        if len(row) != len(header) and row:
            what = f"this row has {len(row)} values, but the header has {len(header)}"
            raise refused(mark, what, "export the file again")
        try:
            values = [float(value) for value in row]
        except ValueError:
            raise refused(mark, "a value is not a number", "export positions alone") from None
        if values:
            first = first if points else values[index]
            pose = {name: values[place] * factor for place, name, factor in columns}
            points.append(MotionPoint(values[index] - first, pose))
    return motion_conversion(content, options, FORMAT.name, points)


def _separator(text: str) -> str:
    head = text.partition("\n")[0]
    return max(_SEPARATORS, key=head.count)


def _matches(content: FileContent) -> bool:
    head, _, rest = content.text.partition("\n")
    names = [name.strip().strip('"').lower() for name in head.split(_separator(head))]
    return len(names) > 1 and bool(rest) and not set(names).isdisjoint(_TIMES)


FORMAT = FileFormat(
    "a table of joint positions (CSV)", _matches, convert=f"{__name__}:convert", makes="motion"
)
