"""Settings of servos: the Homing Offset that the robot file expects, which no start writes."""

from __future__ import annotations

from collections.abc import Iterator

from msgspec.structs import replace

from dxlrun.compile.joints.compiled_servos import SettingsStage
from dxlrun.compile.joints.described_servos import DescribedServo
from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.compile.problems import RobotFile
from dxlrun.features.homing_offset.servo_key import STAGE as KEY
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import ControlTable
from dxlwire.plan.placement import OFFSET


def _expected(file: RobotFile, servo: DescribedServo, table: ControlTable) -> Iterator[RegisterValue]:
    """Yield the Homing Offset that the file expects of a servo, which no start writes."""
    if (offset := KEY.value_of(servo)) is None:
        return
    mark = servo.mark(file.marks, OFFSET)
    if OFFSET not in table.items:
        file.error(mark, f"{table.model} of {servo.title} has no Homing Offset", "remove it")
        return
    try:
        yield replace(any_value(table, OFFSET, offset), write=False)
    except UnfitRegister as error:
        file.error(mark, f"{servo.title}: {error.what}", error.fix)


STAGE = SettingsStage(_expected)
