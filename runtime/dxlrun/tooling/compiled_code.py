r"""Compiled code: functions and structs of C files that a package's build has compiled.

A struct becomes a class of ctypes.

    from dxlrun.tooling.compiled_code import parse_structs

    structs = parse_structs("typedef struct {\n    double x, y;\n} Point;")
    point = structs["Point"](1.0, 2.0)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlwire.compiled import load_compiled as load_compiled
    from dxlwire.compiled import parse_structs as parse_structs
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
