"""Key `homing_offset` of servos: the Homing Offset with which a robot file was measured.

Angles do not depend on it, because each start takes the servo's own offset into the reference. A servo with
another one was calibrated by another program since, perhaps after its horn was turned: no run starts.
"""

from __future__ import annotations

from collections.abc import Iterator

from msgspec.structs import replace

from dxlrun.compile.joints.compiled_servos import SettingsStage
from dxlrun.compile.joints.described_servos import DescribedServo
from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.compile.problems import RobotFile
from dxlrun.description.base_form import key
from dxlrun.features.feature import ServoKey
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import ControlTable
from dxlwire.plan.placement import OFFSET

_HELP = "Homing Offset that the servo must have, ticks; by default any."
_KEY: ServoKey[int | None] = ServoKey(
    OFFSET,
    int | None,
    field=key(_HELP, "-512", None),
    of_one=key(_HELP, "-512", None),
    of_section=key(_HELP, "-512", None),
    before="motor",
)


def _expected(file: RobotFile, servo: DescribedServo, table: ControlTable) -> Iterator[RegisterValue]:
    """Yield the Homing Offset that the file expects of a servo, which no start writes."""
    if (offset := _KEY.value_of(servo)) is None:
        return
    mark = servo.mark(file.marks, OFFSET)
    if OFFSET not in table.items:
        file.error(mark, f"{table.model} of {servo.title} has no Homing Offset", "remove it")
        return
    try:
        yield replace(any_value(table, OFFSET, offset), write=False)
    except UnfitRegister as error:
        file.error(mark, f"{servo.title}: {error.what}", error.fix)


STAGES = (_KEY, SettingsStage(_expected))
