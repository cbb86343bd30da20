"""A robot with 12 servos and 4 devices on one bus: its log is the ledger, and a lost device costs nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from tests.kit.judges import log_has_every_byte, uncaused, unnoticed

from dxlrun import Controller, Interfaces, ParametersModel
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.run import virtual_run
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.replay import log_replay, replay_log
from dxlrun_analysis.report import analyze_log
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

HEAD = """\
name: dozen
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 250}
devices:
  imu: {bus: main, id: 241, model: OpenCR, states: [gyro_x, gyro_y, gyro_z, acc_x, acc_y, acc_z]}
  foot: {bus: main, id: 101, model: generic, states: {force.x: register_1, force.y: register_5}}
  board:
    bus: main
    id: 42
    model: generic
    states: {voltage: register_2, lamp: led}
    commands: {lamp: led, level: register_8}
  core: {bus: main, id: 43, model: bitbots-core}
controllers:
  states: {type: joint_state_broadcaster}
  blinker: {type: blinker, joints: [JOINTS]}
joints:
"""
JOINTS = [f"joint_{number}" for number in range(1, 13)]
PERIOD_NS = 4_000_000


class BlinkerParameters(ParametersModel):
    joints: tuple[str, ...]


class Blinker(Controller[BlinkerParameters]):
    """Swings its joints, and lights the lamp every half second, brighter than it can."""

    Parameters = BlinkerParameters

    @classmethod
    def interfaces(cls, parameters: BlinkerParameters, joints: Any) -> Interfaces:
        return Interfaces(
            parameters.joints,
            ("position",),
            reads=("foot/force.y", "imu/age"),
            device_commands=("board/lamp", "board/level"),
        )

    def update(self, time_ns: int, period_ns: int) -> None:
        seconds = time_ns * 1e-9
        self.context.commands.position[:] = 0.3 * math.sin(3 * seconds)
        self.context.device_commands[:] = 1 + seconds * 2 // 1 % 2, self.context.reads[0]


@pytest.fixture
def dozen(tmp_path, monkeypatch):
    """Build the robot on virtual time, with a log."""
    offers = {**load_plugins().controllers, "blinker": Offer("blinker", Blinker, "elsewhere 2.1")}
    for room in (robot_compiler, virtual_run, log_replay):
        monkeypatch.setattr(room, "load_plugins", lambda *_, **__: PlugIns(offers, {}))

    def build(duration_s):
        lines = [
            f"  {name}: {{bus: main, id: {number}, model: XL430-W250, reference: 180 deg, direction: 1}}"
            for number, name in enumerate(JOINTS, 1)
        ]
        path = tmp_path / "dozen.yaml"
        path.write_text(HEAD.replace("JOINTS", ", ".join(JOINTS)) + "\n".join(lines) + "\n")
        return simulated_robot(path, duration_s=duration_s, log=tmp_path / "run.mcap")

    return build


def inject(run: VirtualRobot, *texts: str) -> None:
    """Hang faults on the line; their times count from the start of the run."""
    begin_ns = 0
    script = FaultScript([parse_fault(text) for text in texts], 0)
    script.attach(run.buses, start_ns=begin_ns, now_ns=begin_ns)


def test_the_log_is_the_ledger_and_a_lost_device_costs_the_servos_nothing(dozen, tmp_path):
    run = dozen(1.3)
    inject(run, "silence servo=101 at=300ms for=150ms", "silence servo=43 at=320ms")
    run.run()
    log = read_log(tmp_path / "run.mcap")
    log_has_every_byte(log, run.ledger.entries)
    assert unnoticed(log, run.ledger.entries) == []
    assert uncaused(log, run.ledger.entries) == []
    cycles, layout = log.cycles, run.record.layout
    # the servos: every reply, every goal, every period
    assert cycles["valid"].all()
    assert (cycles["torque"] == Torque.ON).all()
    assert run.skipped == 0
    assert len(cycles) == 325
    longest = (cycles["read_ns"] - cycles["woken_ns"]).max()
    assert longest < PERIOD_NS - 500_000
    # the devices
    valid = dict(zip(layout.sources, cycles["source_valid"].T, strict=True))
    age_ns = dict(zip(layout.sources, cycles["source_age_ns"].T, strict=True))
    assert valid["board"].all()
    assert np.count_nonzero(~valid["imu"]) <= 1
    assert 150e6 / PERIOD_NS <= np.count_nonzero(~valid["foot"]) <= 1.2e9 / PERIOD_NS
    lost = np.flatnonzero(~valid["core"])
    assert (np.diff(lost) == 1).all()
    assert lost[-1] == len(cycles) - 1
    assert (np.abs(np.diff(age_ns["core"][lost]) - PERIOD_NS) < 1_500_000).all()
    codes = [(EventCode(event.code), event.source) for event in log.events]
    assert {source for code, source in codes if code == EventCode.DEVICE_LOST} == {"foot", "core"}
    assert [source for code, source in codes if code == EventCode.DEVICE_BACK] == ["foot"]
    assert EventCode.SERVO_LOST not in {code for code, _ in codes}
    assert ("board", "clamped to its range 0..1") in {
        (event.source, event.text.rpartition(" is ")[2]) for event in log.events
    }
    assert np.nanmax(cycles["device_command"][:, 0]) == 1.0
    # the analysis, and a replay
    found = analyze_log(tmp_path / "run.mcap")
    (missing,) = (one for one in found.verdict.sentences if one.startswith("Replies are missing: "))
    assert "device 101 (foot) " in missing
    assert missing.endswith(" of 16 servos and devices answered every time.")
    servos = {servo.joint: servo for servo in found.totals.servos}
    assert servos["foot"].device
    assert servos["foot"].lost > 0
    assert servos["joint_1"].lost == 0
    replayed = replay_log(tmp_path / "run.mcap")
    assert replayed.same, replayed


def test_what_devices_measure_and_are_told_is_what_the_bus_has(dozen, tmp_path):
    run = dozen(0.3)
    foot = run.buses[0].device(101)
    foot.registers["register_5"] = 77
    run.run()
    values = dict(zip(run.record.layout.source_states, run.record.sources.values.tolist(), strict=True))
    assert values["foot/force.y"] == 77
    assert values["imu/linear_acceleration.z"] == pytest.approx(9.80665)
    assert values["board/lamp"] == 1
    assert run.buses[0].device(42).registers["register_8"] == 77
    assert run.buses[0].device(42).registers["led"] == 0  # its safe value, at the end
    last = read_log(tmp_path / "run.mcap").cycles[-1]
    assert last["device_command"].tolist() == [1.0, 77.0]
