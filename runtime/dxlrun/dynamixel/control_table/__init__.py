"""Control tables: the places of a servo's control items in its memory, and their units.

`control_table("AX-12A")` is the table of a model, `control_table("MX-28", 2.0)` that of one of its firmwares.
Each model has a data file in `tables/`.
"""

from dxlrun.dynamixel.control_table.models import (
    add_control_table,
    added_control_tables,
    all_tables,
    control_table,
    model_names,
    models_by_number,
    perhaps_meant,
    protocols_of,
)
from dxlrun.dynamixel.control_table.sources import read_control_table
from dxlrun.dynamixel.control_table.table import (
    CAPABILITIES,
    SIGN_BIT,
    Access,
    Area,
    ControlItem,
    ControlTable,
    EffortUnit,
    Encoding,
    decoded,
    side_by_side,
)

__all__ = [
    "CAPABILITIES",
    "SIGN_BIT",
    "Access",
    "Area",
    "ControlItem",
    "ControlTable",
    "EffortUnit",
    "Encoding",
    "add_control_table",
    "added_control_tables",
    "all_tables",
    "control_table",
    "decoded",
    "model_names",
    "models_by_number",
    "perhaps_meant",
    "protocols_of",
    "read_control_table",
    "side_by_side",
]
