"""What does not determine a servo is refused in one sentence that says what is missing, or said beside it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.kit.campaigns import campaign

from dxlrun.channels.cycle import Torque
from dxlrun.errors import InputError
from dxlrun_lab.identify.fit import fit_run
from dxlrun_lab.identify.joint_recording import measured
from dxlrun_lab.identify.known_servo import Servo
from dxlrun_lab.identify.result import KnownLoad, identified
from dxlwire.modes import Mode

pytestmark = pytest.mark.long

LOAD = KnownLoad(0.005, 0.3)


def set_to(**columns: Any) -> Callable[[Any], None]:
    def spoil(cycles: Any) -> None:
        for name, value in columns.items():
            cycles[name][:, 0] = value(cycles) if callable(value) else value

    return spoil


def to_and_fro(cycles: Any) -> Any:
    return 0.5 * np.abs((cycles["read_ns"] * 1e-9 % 2.0) - 1.0)


@pytest.mark.parametrize(
    ("spoil", "rows", "sentence"),
    [
        (set_to(torque=Torque.RELEASED), None, "never under torque with a goal"),
        (set_to(mode=Mode.VELOCITY), None, "never under torque with a goal"),
        (set_to(voltage=np.nan), None, "no supply voltage"),
        (set_to(position=0.1), None, "never moved"),
        (set_to(position=lambda cycles: np.linspace(0.0, 0.5, len(cycles))), None, "hardly moved"),
        (set_to(position=to_and_fro, goal_position=to_and_fro), None, "one speed only"),
        (set_to(), 800, r"only \d\.\d s of this log"),
        (set_to(goal_position=lambda cycles: -cycles["goal_position"][:, 0]), None, "no servo model"),
        pytest.param(
            set_to(goal_position=lambda cycles: np.roll(cycles["goal_position"][:, 0], len(cycles) // 3)),
            None,
            "no servo model fits",
            marks=pytest.mark.campaign(ci=0, night=1, release=1),
        ),
    ],
)
def test_a_run_that_does_not_determine_a_servo(xl330, spoil, rows, sentence):
    cycles = xl330.cycles
    spoil(cycles)
    with pytest.raises(InputError, match=sentence) as caught:
        fit_run(measured(cycles[:rows], 0, xl330.servo))
    (said,) = caught.value.sentences
    assert said.startswith(f"{xl330.servo.joint}: ")


def lost_for_two_seconds(xl330: Any) -> tuple[Any, slice]:
    """Return the cycles of a run whose servo was lost in the middle, and the rows of that."""
    cycles = xl330.cycles
    lost = slice(len(cycles) // 3, len(cycles) // 3 + 400)  # 2 s
    cycles["torque"][lost] = Torque.LOST
    cycles["valid"][lost] = False
    cycles["position"][lost, 0] = cycles["position"][lost.start, 0]
    return cycles, lost


def test_two_seconds_of_a_lost_servo_are_skipped(xl330):
    cycles, lost = lost_for_two_seconds(xl330)
    run = measured(cycles, 0, xl330.servo)
    assert run.lost_s == pytest.approx(2.0, abs=0.2)
    begin, end = (
        float(cycles["read_ns"][row] - cycles["read_ns"][0]) * 1e-9 for row in (lost.start, lost.stop)
    )
    (group,) = run.groups
    spans = zip(group.pieces.start_s, group.pieces.start_s + 1.5, strict=True)
    assert all(last <= begin + 0.01 or first >= end - 0.01 for first, last in spans)


@campaign(ci=0, night=1, release=1)
def test_servo_that_was_lost_for_two_seconds_is_identified(xl330):
    found = xl330.identified(lost_for_two_seconds(xl330)[0], LOAD)
    assert found.motor.torque_constant == pytest.approx(0.38042, rel=0.08)
    assert any("were skipped" in note for note in found.notes)


def test_a_given_voltage_and_an_integral_part(xl330):
    servo, cycles = xl330.servo, xl330.cycles
    cycles["voltage"] = np.nan
    assert measured(cycles, 0, servo, voltage=5.0).voltage[0] == 5.0
    declared = Servo(servo.joint, servo.table, servo.reference, servo.direction, {"position_i_gain": 100})
    with pytest.raises(InputError, match="position_i_gain 100, but the model has no integral gain"):
        measured(xl330.cycles, 0, declared)


@campaign(ci=0, night=1, release=1)
def test_an_ax_12_without_a_current_has_the_manuals_scale(record):
    run = record("AX-12A", 1.0, seconds=12.0)
    found = run.identified(run.cycles, KnownLoad())
    assert found.scale == "manual"
    assert "the intervals exclude its error" in found.scale_sentence
    assert "viscous_friction" not in {value.name for value in found.values}
    assert any("viscous friction and back-EMF cannot be separated" in note for note in found.notes)
    figures = {value.name: value for value in found.values}
    assert "torque_constant" not in figures
    constant = figures["torque_constant_with_viscous_friction"]
    assert constant.expected is not None
    assert constant.expected > 1.06 * 1.708  # of the built-in motor, without its viscous friction
    assert constant.value == pytest.approx(constant.expected, rel=0.05)
    assert figures["resistance"].value == pytest.approx(figures["resistance"].expected, rel=0.05)
    assert found.uncertainty["torque_constant"] > 0.06 * found.motor.torque_constant
    by_manual = {name for name, value in figures.items() if value.by_manual}
    assert by_manual >= {"inertia", "friction", "resistance"}
    assert not by_manual & {"torque_constant_with_viscous_friction", "delay", "position_gain"}
    assert found.motor.p_gain is None
    assert found.motor.position_gain == pytest.approx(run.servo.manual_gain(), rel=0.05)


def test_a_load_that_cannot_be(fitted_xl330):
    run, fits = fitted_xl330
    with pytest.raises(InputError, match=r"less than --load-inertia 0\.1 alone"):
        identified(run, fits, KnownLoad(0.1, 0.3), "test")
    unknown = identified(run, fits, KnownLoad(), "test")
    assert unknown.scale == "current"
    assert unknown.motor.inertia == pytest.approx(0.0069, rel=0.05)  # with the load's
