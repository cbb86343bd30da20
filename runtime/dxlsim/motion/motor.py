"""Motor: model of a servo's motor and gear, from the manual's data and published identifications."""

from __future__ import annotations

import fnmatch
import functools
import tomllib
from pathlib import Path

import msgspec
from msgspec.structs import replace

from dxlsim.motor_model import MotorModel, Stribeck
from dxlwire.control_table import ControlTable

STALL_POWER_W = 20.0
"""Stall torque times no-load speed, W, if the manual gives no stall torque: as an XM430-W350 [i]."""

STALL_CURRENT_A = 1.5  # Used if the manual gives none and the model measures none: as an AX-12A [i]

_FILE = Path(__file__).parent / "motors.toml"


class Motor(msgspec.Struct, frozen=True):
    """Direct-current motor of a servo with its gear, as seen at the horn: torque decreases linearly with
    speed.

    Friction is at most `friction + load_friction * |motor's torque - load's torque|`. In motion
    `viscous_friction` times the speed is added: model M3 of M. Duclusaud et al., "Extended Friction Models
    for the Physics Simulation of Servo Actuators" (arXiv 2410.08650)."""

    stall_torque: float  # Nm of the motor at `voltage` and standstill, without subtracting friction
    damping: float
    """Damping by the motor's own voltage, Nm s/rad: torque constant squared over resistance."""
    torque_per_ampere: float  # Nm/A
    voltage: float  # V at which `stall_torque` holds; 0: at any supply voltage
    inertia: float  # kg m^2 of rotor and gear
    friction: float = 0.0  # Nm (Coulomb)
    load_friction: float = 0.0  # Nm of friction per Nm between the motor's torque and the load's
    viscous_friction: float = 0.0  # Nm s/rad
    p_gain_duty: float = 0.0
    """Duty per rad of error and unit of the P gain's register; 0: not identified, the manual's value
    holds."""
    source: str = ""  # Source of the data that no manual gives
    gain_source: str = ""  # Source of `p_gain_duty`
    stribeck: Stribeck | None = None  # Additional friction near standstill

    @property
    def time_constant(self) -> float:
        """Time constant of the motor's speed without load and friction, s: J R / kt^2."""
        return self.inertia / self.damping

    @property
    def no_load_speed(self) -> float:
        """Speed at `voltage` and full duty, rad/s, at which the motor's torque only balances friction."""
        driving = 1.0 - self.load_friction
        return (driving * self.stall_torque - self.friction) / (
            driving * self.damping + self.viscous_friction
        )


class _Gain(msgspec.Struct, frozen=True):
    item: str
    duty_per_rad: float
    models: tuple[str, ...]
    identified: tuple[str, ...]
    source: str


class _ScaledMotor(msgspec.Struct, frozen=True):
    models: tuple[str, ...]  # Patterns
    like: str  # An identified model


class _Motors(msgspec.Struct, frozen=True):
    identified: tuple[MotorModel, ...]
    scaled: tuple[_ScaledMotor, ...]
    gain: tuple[_Gain, ...]


def motor_of(table: ControlTable, model: MotorModel | None = None) -> Motor:
    """Return the motor of a servo model: that of the motor file `model` if given, or an identified one.

    Without either, its data are the manual's, with inertia and friction of a similar motor."""
    known = _known(table)
    if model is None:
        return known
    motor = identified_motor(model)
    if motor.p_gain_duty:
        return motor
    return replace(motor, p_gain_duty=known.p_gain_duty, gain_source=known.gain_source)


def _known(table: ControlTable) -> Motor:
    motors, model = _motors(), table.model.partition("-FW")[0]
    identified = {each.model: each for each in motors.identified}
    if model in identified:
        motor = identified_motor(identified[model])
    else:
        motor = _scaled(table, identified[next(one.like for one in motors.scaled if _among(model, one))])
    for gain in motors.gain:
        if gain.item in table.items and _among(model, gain):
            known = "" if model in gain.identified else f"[i] as {gain.identified[0]}; "
            return replace(motor, p_gain_duty=gain.duty_per_rad, gain_source=known + gain.source)
    return motor


def identified_motor(model: MotorModel) -> Motor:
    """Convert the parameters of a motor file, or of an entry of motors.toml, to a motor."""
    return Motor(
        stall_torque=model.torque_constant * model.voltage / model.resistance,
        damping=model.torque_constant**2 / model.resistance,
        torque_per_ampere=model.torque_constant,
        voltage=model.voltage,
        inertia=model.inertia,
        friction=model.friction,
        load_friction=model.load_friction,
        viscous_friction=model.viscous_friction,
        p_gain_duty=model.position_gain or 0.0,
        source=model.source,
        gain_source=model.source if model.position_gain else "",
        stribeck=model.stribeck,
    )


def _scaled(table: ControlTable, like: MotorModel) -> Motor:
    """Return a motor with the manual's stall torque and no-load speed, and the rest scaled from the motor of
    `like`.

    The damping gives exactly that speed with friction f, load friction l and viscous friction v: (1 - l) *
    (stall torque - damping * speed) = f + v * speed."""
    model = identified_motor(like)
    torque = table.stall_torque or STALL_POWER_W / table.max_speed
    friction = model.friction / model.stall_torque
    viscous = model.viscous_friction / model.damping
    driving = 1.0 - model.load_friction
    damping = torque * (driving - friction) / (table.max_speed * (driving + viscous))
    limit = table.items.get("current_limit") or table.items.get("torque_limit")  # On PRO the latter, in A
    measured = STALL_CURRENT_A
    if limit is not None and limit.unit == "A":
        measured = limit.maximum * limit.scale
    return Motor(
        stall_torque=torque,
        damping=damping,
        torque_per_ampere=torque / (table.stall_current or measured),
        voltage=table.nominal_voltage,
        inertia=model.time_constant * damping,
        friction=friction * torque,
        load_friction=model.load_friction,
        viscous_friction=viscous * damping,
        source=f"[i] scaled from the {like.model}: {like.source}",
    )


def _among(model: str, those: _ScaledMotor | _Gain) -> bool:
    return any(fnmatch.fnmatchcase(model, pattern) for pattern in those.models)


@functools.cache
def _motors() -> _Motors:
    return msgspec.convert(tomllib.loads(_FILE.read_text("utf-8")), _Motors)
