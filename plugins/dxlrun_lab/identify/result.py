"""Result of an identification: motor figures with their intervals, from a fit and one known torque.

A motion only determines torques relative to the moving inertia. The scale comes from the first known of: the
weight of a load, the current that the servo measures, the stall torque in the manual.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import msgspec
import numpy as np

from dxlrun import InputError, MotorLoad, MotorModel, Stribeck
from dxlrun_lab.identify.fit import Fit
from dxlrun_lab.identify.joint_recording import JointRecording
from dxlrun_lab.identify.known_servo import Servo
from dxlrun_lab.identify.model import ROWS, Floats

Scale = Literal["load", "current", "manual"]

_UNKNOWN = 0.5
"""Relative half-width of the 95 % interval above which a value counts as not identified"""
_CORRELATED = 0.98
_LEAST_GRAVITY = 3.0
"""Number of half-widths of its interval above which the weight of the load is significant"""
UNITS: Mapping[str, str] = {
    "torque_constant": "Nm/A",
    "resistance": "ohm",
    "inertia": "kg m^2",
    "friction": "Nm",
    "load_friction": "Nm/Nm",
    "viscous_friction": "Nm s/rad",
    "stribeck_friction": "Nm",
    "stribeck_velocity": "rad/s",
    "position_gain": "1/rad",
    "delay": "s",
    "load_gravity": "Nm",
    "load_gravity_angle": "rad",
    "stall_torque": "Nm",
    "torque_per_measured_ampere": "Nm/A",
}
_BY_TORQUE = frozenset(
    ("resistance", "inertia", "friction", "viscous_friction", "stribeck_friction", "load_gravity")
)
"""Figures that are proportional to the scale of torques (or inversely). The torque constant is the
back-EMF's."""


class KnownLoad(msgspec.Struct, frozen=True):
    """Properties of the load that the user knows (--load-inertia, --load-gravity)"""

    inertia: float | None = None
    """Inertia in addition to that of motor and gear, kg m^2; None if unknown"""
    gravity: float | None = None
    """Torque of the weight in the horizontal position, Nm; None if unknown"""


class IdentifiedValue(msgspec.Struct, frozen=True):
    """Figure of the servo, such as its torque constant: a row of the result"""

    name: str
    value: float
    half: float | None
    """Half-width of the 95 % interval; None if the value was not fitted"""
    unit: str
    expected: float | None
    """Value of the manual or of the simulation's built-in motor; None if unknown"""
    by_manual: bool = False
    """True if the value depends on the manual's stall torque, whose error is not in the interval"""

    @property
    def identified(self) -> bool:
        """True if the figure was fitted and its interval is narrow enough"""
        return self.half is not None and self.half <= _UNKNOWN * abs(self.value)


class IdentifiedServo(msgspec.Struct, frozen=True):
    """Result of the identification of one joint's servo"""

    joint: str
    model: str
    """Model name of the servo"""
    friction_model: str
    """Selected friction model: m1, m3 or m4 (see Fit)"""
    values: tuple[IdentifiedValue, ...]
    scale: Scale
    """Source of the scale of torques: known load, measured current, or stall torque of the manual"""
    scale_sentence: str
    notes: tuple[str, ...]
    """Remarks, one sentence each"""
    motor: MotorModel
    """Content of the motor file"""
    uncertainty: dict[str, float]
    """Half-widths of the 95 % intervals, by the names in a motor file"""
    seconds: float
    """Usable duration of the run, s"""
    position_rms: float
    """Root mean square error in the fitted pieces, rad"""
    held_out_rms: float
    """Root mean square error in the held-out pieces, rad"""
    candidates: tuple[tuple[str, float, float], ...]
    """Friction models with their BIC and their error in the held-out pieces, rad"""


def identified(run: JointRecording, fits: tuple[Fit, ...], load: KnownLoad, source: str) -> IdentifiedServo:
    """Convert the first of a run's fits to the figures of the servo. `source` is noted in the motor file.

    Raises:
        InputError: The known load contradicts the run, or the scale of torques is unknown.
    """
    fit, servo = fits[0], run.servo
    scale, sentence = _scale_of(fit, servo, load)
    physical = _PhysicalValues(servo, scale, load)
    values = physical.figures_of(fit.numbers.array())
    covariance = _covariance(fit, physical, run)
    half = {name: fit.student * math.sqrt(max(0.0, covariance[i, i])) for i, name in enumerate(values)}
    _check_load(values, load, servo.joint)
    notes = list(_notes(run, fit, scale, load, values, half, covariance))
    given = {"load": {"load_gravity"}, "manual": {"stall_torque"}, "current": set[str]()}[scale]
    fitted = _fitted_names(fit) - given
    if values["load_gravity"] <= _LEAST_GRAVITY * half["load_gravity"] and scale != "load":
        fitted -= {"load_gravity_angle"}
    share = 0.0 if "viscous_friction" in fit.free else _viscous_share(servo)
    expected = _expected(servo, share)
    rows = tuple(
        IdentifiedValue(
            f"{name}_with_viscous_friction" if share and name == "torque_constant" else name,
            value,
            half[name] if name in fitted else None,
            UNITS[name],
            expected.get(name),
            scale == "manual" and name in _BY_TORQUE,
        )
        for name, value in values.items()
        if name in fitted or name == "position_gain"
    )
    half["torque_constant"] = math.hypot(half["torque_constant"], share * values["torque_constant"])
    motor, uncertainty = _motor(servo, fit, values, half, load, run, source)
    return IdentifiedServo(
        joint=servo.joint,
        model=servo.table.model,
        friction_model=fit.friction_model,
        values=rows,
        scale=scale,
        scale_sentence=sentence,
        notes=tuple(notes),
        motor=motor,
        uncertainty={name: value for name, value in uncertainty.items() if name in fitted},
        seconds=run.seconds,
        position_rms=fit.position_rms,
        held_out_rms=fit.held_out_rms,
        candidates=tuple(sorted((each.friction_model, each.bic, each.held_out_rms) for each in fits)),
    )


# The scale


def _scale_of(fit: Fit, servo: Servo, load: KnownLoad) -> tuple[Scale, str]:
    if load.gravity:
        return "load", f"torques are scaled by the known weight of the load, {load.gravity:g} Nm"
    if "resistance" in fit.free:
        return (
            "current",
            "torques are scaled by the measured current, because a torque constant has the same value in "
            "Nm/A and V s/rad",
        )
    if servo.table.stall_torque and servo.table.nominal_voltage:
        return "manual", (
            f"torques are scaled by the manual's stall torque, {servo.table.stall_torque:g} Nm at "
            f"{servo.table.nominal_voltage:g} V, and the intervals exclude its error; "
            "give --load-gravity to scale them by a known weight"
        )
    raise InputError(
        f"{servo.joint}: the scale of torques is unknown, because {servo.table.model} has no measured "
        "current and no stall torque in its manual; attach a known weight and give --load-gravity"
    )


class _PhysicalValues(msgspec.Struct, frozen=True):
    """Conversion of the model's parameters, which are relative to the inertia, to figures in SI units"""

    servo: Servo
    scale: Scale
    load: KnownLoad

    def figures_of(self, numbers: Floats) -> dict[str, float]:
        """Return the figures by name (see UNITS), from parameters in the order of ROWS."""
        at = {name: float(numbers[row]) for name, row in ROWS.items()}
        drive, constant = at["drive"], at["back_emf"]
        gravity = math.hypot(at["gravity_sin"], at["gravity_cos"])
        inertia = self._inertia(drive, constant, gravity, at["resistance"])
        resistance = constant / (drive * inertia)
        p_gain = self.servo.p_gain
        return {
            "torque_constant": constant,
            "resistance": resistance,
            "inertia": inertia - (self.load.inertia or 0.0),
            "friction": at["friction"] * inertia,
            "load_friction": at["load_friction"],
            "viscous_friction": at["viscous_friction"] * inertia,
            "stribeck_friction": at["stribeck_friction"] * inertia,
            "stribeck_velocity": at["stribeck_speed"],
            "position_gain": at["gain"] / (p_gain or 1),
            "delay": at["delay"],
            "load_gravity": gravity * inertia,
            "load_gravity_angle": math.atan2(at["gravity_cos"], at["gravity_sin"]),
            "stall_torque": drive * inertia * self._voltage,
            "torque_per_measured_ampere": constant * at["resistance"] / resistance,
        }

    @property
    def _voltage(self) -> float:
        return self.servo.table.nominal_voltage or 12.0

    def _inertia(self, drive: float, constant: float, gravity: float, resistance: float) -> float:
        if self.scale == "load":
            return (self.load.gravity or 0.0) / max(gravity, 1e-9)
        if self.scale == "current":
            return constant / (drive * resistance)
        return self.servo.table.stall_torque / (drive * self._voltage)


def _check_load(values: Mapping[str, float], load: KnownLoad, joint: str) -> None:
    if values["inertia"] <= 0.0:
        raise InputError(
            f"{joint}: motor and load have {values['inertia'] + (load.inertia or 0.0):.3g} kg m^2 in "
            f"this run, less than --load-inertia {load.inertia:g} alone; check the load"
        )


def _covariance(fit: Fit, physical: _PhysicalValues, run: JointRecording) -> Floats:
    """Return the covariance of the figures, from that of the parameters and the resolution of the voltage."""
    numbers = fit.numbers.array()

    def slopes(direction: Floats) -> Floats:
        step = 1e-4
        up = physical.figures_of(numbers + step * direction)
        down = physical.figures_of(numbers - step * direction)
        return np.array([(up[name] - down[name]) / (2 * step) for name in up])

    directions = np.zeros((len(fit.free), len(numbers)))
    sizes = np.maximum(np.abs(numbers[[ROWS[name] for name in fit.free]]), 1e-2)
    directions[range(len(fit.free)), [ROWS[name] for name in fit.free]] = sizes
    jacobian = np.stack([slopes(direction) for direction in directions], axis=1) / sizes
    covariance: Floats = jacobian @ fit.covariance @ jacobian.T
    # An error of the voltage scales all parameters that contain volts.
    relative = run.servo.voltage_step / math.sqrt(12) / float(np.mean(run.voltage))
    volts = np.zeros(len(numbers))
    for name, power in (("drive", -1.0), ("back_emf", 1.0), ("resistance", 1.0)):
        volts[ROWS[name]] = power * numbers[ROWS[name]]
    by_voltage = slopes(volts) * relative
    return covariance + np.outer(by_voltage, by_voltage)


# Remarks on the figures


def _fitted_names(fit: Fit) -> set[str]:
    names = {"torque_constant", "resistance", "inertia", "friction", "delay", "stall_torque"}
    names |= {"load_gravity", "load_gravity_angle"}
    by_number = {
        "load_friction": ("load_friction",),
        "viscous_friction": ("viscous_friction",),
        "stribeck_friction": ("stribeck_friction", "stribeck_velocity"),
        "gain": ("position_gain",),
        "resistance": ("torque_per_measured_ampere",),
    }
    for number, figures in by_number.items():
        names |= set(figures) if number in fit.free else set()
    return names


def _notes(  # noqa: PLR0917  all that a sentence may be about
    run: JointRecording,
    fit: Fit,
    scale: Scale,
    load: KnownLoad,
    values: Mapping[str, float],
    half: Mapping[str, float],
    covariance: Floats,
) -> list[str]:
    servo = run.servo
    notes = []
    if servo.p_gain_item is not None and servo.p_gain_item not in servo.declared:
        notes.append(
            f"{servo.p_gain_item} is assumed to have its factory value, {servo.p_gain}: "
            "the robot file does not declare it"
        )
    if "gain" not in fit.free:
        _, where = servo.expected_gain()
        notes.append(
            f"position_gain is from {where}, not identified: the duty was not measured and never reached its "
            "limit; an error of position_gain also changes torque constant and resistance"
        )
    if "viscous_friction" not in fit.free:
        notes += [
            "viscous friction and back-EMF cannot be separated without a measured current: torque constant, "
            "resistance and their expected values include both",
            "the interval of the torque constant in the motor file allows for a share of viscous friction of "
            f"{_viscous_share(servo):.1%}",
        ]
    if load.inertia is None:
        notes.append("the inertia includes motor and load; give --load-inertia to separate them")
    if scale == "load" and "resistance" in fit.free:
        ampere = values["torque_per_measured_ampere"] / values["torque_constant"]
        if abs(ampere - 1.0) > 0.1:
            notes.append(
                f"the measured current gives {ampere:.2f} x the torque of the back-EMF: the servo does not "
                "measure the motor current, or the gear has losses"
            )
    names = list(values)
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    for first, second in (("friction", "stribeck_friction"), ("torque_constant", "viscous_friction")):
        i, j = names.index(first), names.index(second)
        both = {first, second} <= _fitted_names(fit)
        if both and abs(covariance[i, j] / (spread[i] * spread[j])) > _CORRELATED:
            notes.append(f"{first} and {second} are hardly separable in this run; their sum is more exact")
    if run.lost_s > 0.05 * run.seconds:
        notes.append(f"{run.lost_s:.1f} s of the run were skipped: limp, lost, or in another mode")
    if fit.held_out_rms > 1.5 * fit.position_rms:
        notes.append(
            f"the error in held-out seconds ({fit.held_out_rms:.2g} rad) exceeds that of the fit "
            f"({fit.position_rms:.2g} rad): the servo changed during the run, or an external force moved it"
        )
    return notes


def _viscous_share(servo: Servo) -> float:
    """Return the share of viscous friction in the damping of the simulation's motor (from publications)."""
    built_in = servo.built_in
    return built_in.viscous_friction / (built_in.damping + built_in.viscous_friction)


def _expected(servo: Servo, viscous_share: float) -> dict[str, float]:
    """Return the expected figures by name, from the simulation's motor and the manual's stall torque.

    `viscous_share` is the share of viscous friction in the damping, which the torque constant includes if the
    two are not separated.
    """
    motor = servo.built_in
    voltage = motor.voltage or 12.0
    constant = motor.damping * voltage / motor.stall_torque / (1.0 - viscous_share)
    found = {
        "torque_constant": constant,
        "resistance": constant * voltage / motor.stall_torque,
        "inertia": motor.inertia,
        "friction": motor.friction,
        "load_friction": motor.load_friction,
        "viscous_friction": motor.viscous_friction,
        "position_gain": servo.expected_gain()[0] / (servo.p_gain or 1),
        "torque_per_measured_ampere": motor.torque_per_ampere,
    }
    if servo.table.stall_torque:
        found["stall_torque"] = servo.table.stall_torque
    return {name: value for name, value in found.items() if value}


# The motor file


def _motor(  # noqa: PLR0917  all that a motor file has
    servo: Servo,
    fit: Fit,
    values: Mapping[str, float],
    half: Mapping[str, float],
    load: KnownLoad,
    run: JointRecording,
    source: str,
) -> tuple[MotorModel, dict[str, float]]:
    """Return the content of a motor file with all significant figures, and half-widths by name."""
    fitted = _fitted_names(fit)
    told = {
        name: value
        for name, value in values.items()
        if name in fitted and (abs(value) > half[name] or name == "delay")
    }
    heavy = values["load_gravity"] > _LEAST_GRAVITY * half["load_gravity"] or bool(load.gravity)
    stribeck = None
    if "stribeck_friction" in told:
        stribeck = Stribeck(told["stribeck_friction"], values["stribeck_velocity"])
    motor = MotorModel(
        model=servo.table.model,
        voltage=round(float(np.mean(run.voltage)), 3),
        torque_constant=values["torque_constant"],
        resistance=values["resistance"],
        inertia=values["inertia"],
        friction=told.get("friction", 0.0),
        load_friction=told.get("load_friction", 0.0),
        viscous_friction=told.get("viscous_friction", 0.0),
        stribeck=stribeck,
        position_gain=values["position_gain"],
        p_gain=servo.p_gain,
        delay_ns=max(0, round(values["delay"] * 1e9)),
        load=MotorLoad(
            load.inertia or 0.0,
            values["load_gravity"] if heavy else 0.0,
            values["load_gravity_angle"] if heavy else 0.0,
        ),
        source=source,
    )
    names = {"torque_constant", "resistance", "inertia", "delay"} | (told.keys() & UNITS.keys())
    names -= {"stall_torque", "torque_per_measured_ampere", "stribeck_velocity"}
    names -= set() if heavy else {"load_gravity", "load_gravity_angle"}
    names |= {"stribeck_velocity"} if stribeck else set()
    return motor, {name: half[name] for name in UNITS if name in names}
