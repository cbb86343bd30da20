"""Features: public names for a section or a key that a package adds to the robot file.

A feature is a package with files of fixed names. Each has an object `STAGE` of a class of this page:
`Section` in `form.py`, `JointKey` in `joint_key.py`, `ServoKey` in `servo_key.py`, `PolicyKey` in
`policy_key.py`, `PoseStage` in `pose_form.py`, `CompileStage` in `compile.py`, `SettingsStage` in
`settings.py`, `LayerStage` in `layer.py`, `BusStage` in `runtime.py`, `MonitorStage` in `monitor.py`,
`SafeStage` in `safe.py`, `ProcessStage` in `process.py`, `ReaderStage` in `reader.py`, `TableStage` in
`table.py`. One of the first four is required. A small feature is one module with these objects in a tuple
`STAGES`.
Forms use the names of `dxlrun.tooling.files`. The hook `dxlrun_features` registers the feature:

    from dxlrun import hookimpl
    from dxlrun.tooling.features import Feature

    @hookimpl
    def dxlrun_features() -> list[Feature]:
        return [Feature("lights", "dxlrun_lights")]
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.channels.event_records import EventBody as EventBody
    from dxlrun.channels.event_records import EventSink as EventSink
    from dxlrun.channels.event_records import EventText as EventText
    from dxlrun.channels.event_records import event_text as event_text
    from dxlrun.compile.check_report import Row as Row
    from dxlrun.compile.check_report import TableStage as TableStage
    from dxlrun.compile.contribution import BusDevice as BusDevice
    from dxlrun.compile.contribution import Compilation as Compilation
    from dxlrun.compile.contribution import CompileStage as CompileStage
    from dxlrun.compile.contribution import Contribution as Contribution
    from dxlrun.compile.joints.compiled_servos import SettingsStage as SettingsStage
    from dxlrun.compile.joints.described_servos import DescribedServo as DescribedServo
    from dxlrun.compile.problems import RobotFile as RobotFile
    from dxlrun.contract.hardware import Hardware as Hardware
    from dxlrun.control.monitors.monitor_stage import Monitor as Monitor
    from dxlrun.control.monitors.monitor_stage import MonitorStage as MonitorStage
    from dxlrun.control.monitors.policy_actions import PolicyActions as PolicyActions
    from dxlrun.control.sampled_sources import ProcessStage as ProcessStage
    from dxlrun.control.sampled_sources import ReaderContext as ReaderContext
    from dxlrun.control.sampled_sources import ReaderStage as ReaderStage
    from dxlrun.control.sampled_sources import SampledSource as SampledSource
    from dxlrun.control.sampled_sources import SourceContext as SourceContext
    from dxlrun.control.sampled_sources import SourceProcess as SourceProcess
    from dxlrun.control.sampled_sources import SourceReader as SourceReader
    from dxlrun.description.robot import WrittenPolicy as WrittenPolicy
    from dxlrun.dynamixel.bus_part import BusContext as BusContext
    from dxlrun.dynamixel.bus_part import BusPart as BusPart
    from dxlrun.dynamixel.bus_part import BusStage as BusStage
    from dxlrun.dynamixel.bus_part import SafeStage as SafeStage
    from dxlrun.dynamixel.findings import Findings as Findings
    from dxlrun.dynamixel.hardware_layer import HardwareLayer as HardwareLayer
    from dxlrun.dynamixel.hardware_layer import LayerStage as LayerStage
    from dxlrun.dynamixel.hardware_layer import PreparedLayer as PreparedLayer
    from dxlrun.features.feature import Feature as Feature
    from dxlrun.features.feature import JointKey as JointKey
    from dxlrun.features.feature import PolicyKey as PolicyKey
    from dxlrun.features.feature import PoseStage as PoseStage
    from dxlrun.features.feature import Section as Section
    from dxlrun.features.feature import ServoKey as ServoKey
    from dxlrun.features.feature import SolvedPose as SolvedPose
    from dxlrun.plan.loop_plan import SourcePlan as SourcePlan
    from dxlwire.bus_plan import RegisterValue as RegisterValue
    from dxlwire.exchange.bus_engine import Lines as Lines
    from dxlwire.exchange.idle import Urgency as Urgency
    from dxlwire.plan.planning import plan_line as plan_line
    from dxlwire.plan.retry import limit_patience as limit_patience
    from dxlwire.plan.retry import retry as retry
    from dxlwire.transaction import Program as Program
    from dxlwire.transaction import Reply as Reply
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
