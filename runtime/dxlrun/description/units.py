"""Units: converts quantities with units as text, `60 deg` or `500 us`, to numbers in SI units.

Each quantity converts text to a number in its SI unit, and is the type of a model's field, such as `Angle` or
`Duration`. A number without a unit is an error, because `60` could be deg or rad. Two exceptions: a bare
`Rate` is in Hz, and bare seconds of a command line are in s. In JSON a quantity is text that is read to the
same value.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    WithJsonSchema,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from dxlrun.description.base_form import validation_error
from dxlrun.description.mistakes.syntax import list_text
from dxlsim.texts.duration import DURATION_NS, LONGEST_NS, LONGEST_QUANTITY, nanoseconds, split_quantity
from dxlwire.joint_unit import JointUnit


class Measure(float):
    """A number in SI with its unit, for keys that accept different quantities (angle or length)."""

    __slots__ = ("unit",)
    unit: str

    def __new__(cls, value: float, unit: str) -> Measure:
        """Make a number with its SI unit: `Measure(0.02, "m")`."""
        self = super().__new__(cls, value)
        self.unit = unit
        return self

    @property
    def joint_unit(self) -> JointUnit:
        """Kind of joint (rotary or linear) that this unit belongs to; raise LookupError if none."""
        return JointUnit.find_by_quantity(self.unit)


def plain(measure: Measure | None) -> float | None:
    """Return a measure as a float without its unit, for JSON; None stays None."""
    return None if measure is None else float(measure)


class Quantity:
    """A quantity such as an angle: its units, and the conversion of text to SI by a call.

    The call raises ValueError with an example.

    Args:
        what: Name with its article, for messages.
        si: SI unit.
        units: Size of each unit in the SI unit.
        examples: Examples for messages.
        bare: True: a number without a unit is in the SI unit.
        least: Lowest value.
        most: Highest value.
    """

    def __init__(
        self,
        what: str,
        si: str,
        units: Mapping[str, float],
        examples: str,
        *,
        bare: bool = False,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> None:
        self.what, self.si, self.units, self.examples = what, si, units, examples
        self._bare, self._least, self._most = bare, least, most

    def __call__(self, text: object) -> float:
        """Convert text to a number in the SI unit; raise ValueError."""
        if self._bare and isinstance(text, int | float) and not isinstance(text, bool):
            return text
        number, unit = split(text, self.what, self.units, self.examples, bare=self.si if self._bare else "")
        value = float(number) * self.units[unit]
        if not math.isfinite(value):
            raise validation_error(f"{text!r} is too large", f"write {self.what} such as {self.examples}")
        if not self._least <= value <= self._most:
            raise validation_error(
                f"{text!r} is not {self.what} from {self._least:.0%} to {self._most:.0%}",
                f"write {self.what} such as {self.examples}",
            )
        return value

    def format_value(self, value: float) -> str:
        """Write a number in SI as text that this quantity reads back to the same number."""
        return f"{value!r} {self.si}" if self.si in self.units else f"{value * 100:.12g} %"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 (pydantic's)
        """Return pydantic's schema, which makes a field of this type read and write text with a unit."""
        written = core_schema.plain_serializer_function_ser_schema(
            self.format_value, return_schema=core_schema.str_schema(), when_used="json"
        )
        return core_schema.no_info_before_validator_function(
            self, handler(source), serialization=None if self._bare else written
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of text with one of the units."""
        text = text_schema(example_of(self), self.units)
        return {"anyOf": [handler(schema), text]} if self._bare else text


class AlternativeQuantity(Quantity):
    """A quantity that may be of different kinds, such as an angle or a length; a call returns a `Measure`."""

    def __init__(
        self, what: str, kinds: tuple[Quantity, ...], examples: str, *, above_zero: bool = False
    ) -> None:
        self._kinds = {unit: kind for kind in kinds for unit in kind.units}
        self._above_zero = above_zero
        sizes = {unit: kind.units[unit] for unit, kind in self._kinds.items()}
        super().__init__(what, "", sizes, examples)

    def __call__(self, text: object) -> Measure:
        """Convert text to a number in SI with its unit; raise ValueError."""
        if isinstance(text, Measure):  # was read before
            return text
        number, unit = split(text, self.what, self.units, self.examples)
        value = float(number) * self.units[unit]
        if self._above_zero and not 0 < value < math.inf:
            raise validation_error(f"{text!r} is not above 0", f"write {self.what} such as {self.examples}")
        if not math.isfinite(value):
            raise validation_error(f"{text!r} is too large", f"write {self.what} such as {self.examples}")
        return Measure(value, self._kinds[unit].si)

    def format_value(self, value: float) -> str:
        """Write a `Measure` as text that is read back to the same value."""
        unit = value.unit if isinstance(value, Measure) else ""
        return f"{float(value) * 100!r} %" if unit == "1" else f"{float(value)!r} {unit}"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 (pydantic's)
        """Return pydantic's schema, which makes a field of this type read and write text with a unit."""
        return core_schema.no_info_plain_validator_function(
            self,
            serialization=core_schema.plain_serializer_function_ser_schema(
                self.format_value, return_schema=core_schema.str_schema(), when_used="json"
            ),
        )


class UnlimitedQuantity(AlternativeQuantity):
    """A quantity that may be of different kinds and must be above 0, or is `inf`: no limit."""

    def __call__(self, text: object) -> Measure:
        """Convert text to a number in SI with its unit; infinity has no unit."""
        if text == "inf" or (isinstance(text, float) and math.isinf(text) and text > 0):
            return text if isinstance(text, Measure) else Measure(math.inf, "")
        found = super().__call__(text)
        if not found > 0:
            raise validation_error(
                f"{text!r} is not above 0", f"write {self.what} such as {self.examples}, or inf"
            )
        return found

    def format_value(self, value: float) -> str:
        """Write a `Measure` as text that is read back to the same value."""
        return "inf" if math.isinf(value) else super().format_value(value)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of text with one of the units, or `inf`."""
        text = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [text, {"type": "string", "const": "inf"}]}


def _per(units: Mapping[str, float], divisor: str) -> dict[str, float]:
    return {f"{unit}/{divisor}": size for unit, size in units.items()}


_DEG = math.pi / 180
_ANGLE = {"rad": 1.0, "deg": _DEG}
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_TIME = {"us": 1e-6, "ms": 1e-3, "s": 1.0}

angle = Quantity("an angle", "rad", _ANGLE, "60 deg or 1.05 rad")
angular_velocity = Quantity(
    "an angular velocity",
    "rad/s",
    _per(_ANGLE, "s") | {"rpm": 2 * math.pi / 60},
    "2 rad/s, 30 deg/s or 5 rpm",
)
angular_acceleration = Quantity(
    "an angular acceleration", "rad/s^2", _per(_ANGLE, "s^2"), "10 rad/s^2 or 90 deg/s^2"
)
angular_jerk = Quantity("an angular jerk", "rad/s^3", _per(_ANGLE, "s^3"), "100 rad/s^3 or 900 deg/s^3")
length = Quantity("a length", "m", _LENGTH, "0.2 m, 20 cm or 200 mm")
linear_velocity = Quantity("a linear velocity", "m/s", _per(_LENGTH, "s"), "0.2 m/s or 200 mm/s")
linear_acceleration = Quantity(
    "a linear acceleration", "m/s^2", _per(_LENGTH, "s^2"), "1 m/s^2 or 500 mm/s^2"
)
linear_jerk = Quantity("a linear jerk", "m/s^3", _per(_LENGTH, "s^3"), "5 m/s^3 or 500 mm/s^3")
mass = Quantity("a mass", "kg", {"kg": 1.0, "g": 1e-3}, "0.3 kg or 300 g")
torque = Quantity("a torque", "Nm", {"Nm": 1.0, "mNm": 1e-3}, "0.3 Nm or 20 mNm")
force = Quantity("a force", "N", {"N": 1.0, "mN": 1e-3}, "2 N or 500 mN")
inertia = Quantity(
    "a moment of inertia",
    "kg m^2",
    {"kg m^2": 1.0, "kg cm^2": 1e-4, "g cm^2": 1e-7},
    "0.01 kg m^2, 5 kg cm^2 or 300 g cm^2",
)
voltage = Quantity("a voltage", "V", {"V": 1.0, "mV": 1e-3}, "12 V")
torque_constant = Quantity(
    "a torque constant", "Nm/A", {"Nm/A": 1.0, "mNm/A": 1e-3, "V s/rad": 1.0}, "1.6 Nm/A or 1.6 V s/rad"
)
resistance = Quantity("a resistance", "ohm", {"ohm": 1.0, "mohm": 1e-3}, "3.6 ohm")
viscous_friction = Quantity(
    "a viscous friction", "Nm s/rad", {"Nm s/rad": 1.0, "mNm s/rad": 1e-3}, "0.01 Nm s/rad"
)
stiffness = Quantity("a duty per rad", "1/rad", {"1/rad": 1.0, "%/rad": 1e-2}, "0.158 1/rad or 15.8 %/rad")
share = Quantity("a share", "1", {"%": 1e-2}, "5 %", least=0.0, most=1.0)
current = Quantity("a current", "A", {"A": 1.0, "mA": 1e-3}, "800 mA")
temperature = Quantity("a temperature", "degC", {"degC": 1.0}, "70 degC")
fraction = Quantity("a share of the maximum", "1", {"%": 1e-2}, "40 %")
register_time = Quantity("a time", "s", _TIME, "500 us or 1 ms")
rate = Quantity("a rate", "Hz", {"Hz": 1.0, "kHz": 1e3}, "50, 50 Hz or 1 kHz", bare=True)
frequency = Quantity("a frequency", "Hz", {"Hz": 1.0, "kHz": 1e3}, "0.5 Hz or 2 kHz")
seconds = Quantity(
    "a time",
    "s",
    _TIME | {"min": 60.0, "h": 3600.0},
    "2, 2 s, 500 ms or 1 min",
    bare=True,
)

_TABLE = (angle, angular_velocity, angular_acceleration, register_time, voltage, current, torque)
_OF_TABLES: Mapping[str, Quantity] = {one.si: one for one in (*_TABLE, temperature, fraction)}
_SIZE_BYTES: Mapping[str, int] = {
    "kB": 1_000,
    "MB": 1_000_000,
    "GB": 1_000_000_000,
    "KiB": 1 << 10,
    "MiB": 1 << 20,
    "GiB": 1 << 30,
}


def duration(text: object, *, bare: str = "") -> int:
    """Convert a time such as `500 us`, `1 ms`, `2 s` or `1 min` to ns; raise ValueError with an example.

    `bare` is the unit of numbers without a unit.
    """
    written = "500 us, 1 ms, 2 s or 1 min"
    number, unit = split(text, "a duration", DURATION_NS, written, bare=bare)
    value = nanoseconds(number, unit)
    if value is None:
        raise validation_error(
            f"{text!r} is not a duration from 0 s to 31 years", f"write a duration such as {written}"
        )
    return value


def quantity(text: str, unit: str) -> float:
    """Convert text with any unit of a kind to a number in the kind's SI unit, as control tables use it.

    Args:
        text: The quantity.
        unit: rad, rad/s, rad/s^2, s, V, A, Nm, degC or 1 (a fraction: `40 %`).

    Raises:
        ValueError: The text is not a quantity of this kind; the message has an example.
    """
    return _OF_TABLES[unit](text)


def split(
    text: object, what: str, units: Mapping[str, object], written: str, *, bare: str = ""
) -> tuple[str, str]:
    """Split text into number and unit; `bare` is the unit if it has none. Raises an error with a fix."""
    if isinstance(text, int | float) and not isinstance(text, bool):
        raise validation_error(f"{text} has no unit", f"write {what} with its unit, such as {written}")
    if not isinstance(text, str):
        raise validation_error(f"this is not {what}", f"write {what} such as {written}")
    parts = split_quantity(text)
    if parts is None:
        fix = _meant(text[:LONGEST_QUANTITY], units) or f"write {what} such as {written}"
        raise validation_error(f"{text[:LONGEST_QUANTITY]!r} is not {what}", fix)
    number, unit = parts[0], parts[1] or bare
    if not unit:
        raise validation_error(f"{text!r} has no unit", f"write {what} with its unit, such as {written}")
    if unit not in units:
        fix = _meant(text, units) or f"write {what} such as {written}"
        raise validation_error(f"{text!r} has the wrong unit {unit} for {what}", fix)
    return number, unit


_UNIT_WORDS: Mapping[str, str] = {
    "rad": "rads radian radians",
    "deg": "° degs degree degrees",
    "rpm": "rev/min revs/min r/min",
    "s": "sec secs second seconds",
    "ms": "msec msecs millisecond milliseconds",
    "us": "µs usec microsecond microseconds",
    "min": "minute minutes",
    "h": "hour hours",
    "m": "meter meters metre metres",
    "mm": "millimeter millimeters millimetre",
    "Nm": "n.m n*m nm n-m newtonmeter",
    "A": "a amp amps ampere",
    "mA": "ma milliamp milliamps",
    "V": "v volt volts",
    "%": "percent pct",
    "Hz": "hz hertz",
    "kHz": "khz",
    "g": "gram grams",
    "kg": "kilogram kilograms",
}
"""Units with other spellings of each, for suggestions."""


def _meant(text: str, units: Mapping[str, object]) -> str:
    """Return the fix for a quantity with a misspelled unit, or for two values; empty if none is known."""
    if several := list_text(text):
        return f"write the two values as a list: {several}"
    match = re.fullmatch(r"([-+]?[0-9_.]+(?:[eE][-+]?\d+)?)\s*(\D.*)", text.strip())
    if match is None:
        return (
            "write a number, such as 180 deg for pi" if re.search(r"\bpi\b", text) and "deg" in units else ""
        )
    powers = re.sub(r"([A-Za-z])\*{0,2}([23])$", r"\1^\2", match[2].replace("²", "^2").replace("³", "^3"))
    name, slash, divisor = powers.partition("/")
    base, power, exponent = divisor.partition("^")
    unit = f"{_unit_for(name)}{slash}{_unit_for(base)}{power}{exponent}"
    unit = unit if unit in units else _unit_for(powers)
    return f"write {match[1]} {unit}" if unit in units else ""


def _unit_for(name: str) -> str:
    """Return the correct unit for another spelling, or the text itself if it is not known."""
    word = name.strip().lower()
    return next((unit for unit, words in _UNIT_WORDS.items() if word in words.split()), name.strip())


def units_of(note: object) -> Mapping[str, float]:
    """Return the units of a field's quantity and their size in its SI unit (ns); empty: not a quantity.

    Args:
        note: Metadata of the field's `Annotated` type.
    """
    if isinstance(note, Quantity):
        return note.units
    return DURATION_NS if isinstance(note, BeforeValidator) and note.func is duration else {}


def example_of(note: object) -> str:
    """Return an example of a field's quantity, such as `60 deg`; empty if it is not one."""
    if isinstance(note, Quantity):
        return note.examples.split(",")[0].split(" or ")[0]
    return "1 s" if units_of(note) else ""


def bound_text(bound: float, units: Mapping[str, float], written: object) -> str:
    """Write a bound in the unit of the value that exceeds it: 10_000_000 (ns) as `10 ms` for `5 ms`.

    Args:
        bound: In the field's unit: SI, or ns.
        units: See `units_of`.
        written: The value in the file; without a unit the bound is returned without a unit, too.
    """
    parts = split_quantity(written) if isinstance(written, str) else None
    if parts is None or parts[1] not in units or not bound:
        return f"{bound:g}"
    return f"{bound / units[parts[1]]:g} {parts[1]}"


def text_schema(example: str, units: Mapping[str, object]) -> dict[str, Any]:
    """Return the JSON Schema of text with a number and one of these units."""
    # JSON Schema does not allow an escaped space.
    names = "|".join(re.escape(unit).replace("\\ ", " ") for unit in units)
    pattern = rf"^\s*[-+]?[0-9_.]+([eE][-+]?[0-9]+)?\s*({names})\s*$"
    return {"type": "string", "pattern": pattern, "examples": [example]}


effort = AlternativeQuantity(
    "an effort", (torque, force, current, fraction), "0.3 Nm, 800 mA or 40 %", above_zero=True
)
position = AlternativeQuantity("an angle or a length", (angle, length), "60 deg, or 20 mm for a linear joint")
speed = AlternativeQuantity(
    "a velocity", (angular_velocity, linear_velocity), "2 rad/s, or 50 mm/s for a linear joint"
)
acceleration = AlternativeQuantity(
    "an acceleration",
    (angular_acceleration, linear_acceleration),
    "10 rad/s^2, or 1 m/s^2 for a linear joint",
)
tolerance = UnlimitedQuantity("a tolerance", (angle, length), "5 deg, or 5 mm for a linear joint")
rest_speed = UnlimitedQuantity(
    "a speed", (angular_velocity, linear_velocity), "5 deg/s, or 5 mm/s for a linear joint"
)
torque_or_force = AlternativeQuantity(
    "a torque or a force", (torque, force), "0.3 Nm, or 2 N for a linear joint"
)

Angle = Annotated[float, angle]
AngularVelocity = Annotated[float, angular_velocity]
AngularAcceleration = Annotated[float, angular_acceleration]
AngularJerk = Annotated[float, angular_jerk]
Length = Annotated[float, length]
LinearVelocity = Annotated[float, linear_velocity]
LinearAcceleration = Annotated[float, linear_acceleration]
LinearJerk = Annotated[float, linear_jerk]
Mass = Annotated[float, mass]
Torque = Annotated[float, torque]
Inertia = Annotated[float, inertia]
Voltage = Annotated[float, voltage]
Temperature = Annotated[float, temperature]
TorqueConstant = Annotated[float, torque_constant]
Resistance = Annotated[float, resistance]
ViscousFriction = Annotated[float, viscous_friction]
Stiffness = Annotated[float, stiffness]
Share = Annotated[float, share]
Rate = Annotated[float, rate]
Frequency = Annotated[float, frequency]
Time = Annotated[float, register_time]
Effort = Annotated[Measure, effort]
Position = Annotated[Measure, position]
Speed = Annotated[Measure, speed]
Acceleration = Annotated[Measure, acceleration]
TorqueOrForce = Annotated[Measure, torque_or_force]
Tolerance = Annotated[float, Field(allow_inf_nan=True), tolerance]
"""Distance in a file, converted to rad or m: above 0, or `inf` for no limit."""
RestSpeed = Annotated[float, Field(allow_inf_nan=True), rest_speed]
"""Speed in a file, converted to rad/s or m/s: above 0, or `inf` for no limit."""
Angles = Annotated[tuple[Angle, ...], Field(strict=False)]
"""List of angles in a file such as `[60 deg, 1 rad]`, converted to rad."""


def _or_word(value: object, *words: str) -> int | str:
    if isinstance(value, str) and value in words:
        return 0 if value == "off" else value
    try:
        return duration(value)
    except PydanticCustomError as error:
        context = error.context or {}
        more = " or ".join(words) if words[1:] else f"or {words[0]}"
        raise validation_error(str(context["what"]), f"{context['fix']}, {more}") from error


def _nanoseconds(value: int | str) -> str:
    return f"{value} ns" if isinstance(value, int) else value


_DURATION_SCHEMA = text_schema("500 us", DURATION_NS)
Duration = Annotated[
    int,
    BeforeValidator(duration),
    PlainSerializer(_nanoseconds, return_type=str, when_used="json"),
    WithJsonSchema(_DURATION_SCHEMA),
]
"""Time in a file such as `500 us` or `2 s`, converted to ns; never negative."""

AutoDuration = Annotated[
    int | Literal["auto"],
    BeforeValidator(lambda value: _or_word(value, "auto")),
    PlainSerializer(_nanoseconds, return_type=str, when_used="json"),
    WithJsonSchema({"anyOf": [_DURATION_SCHEMA, {"type": "string", "const": "auto"}]}),
]
"""Time as Duration, converted to ns, or the word `auto`."""

Polling = Annotated[
    int | Literal["auto"],
    BeforeValidator(lambda value: _or_word(value, "auto", "off")),
    PlainSerializer(lambda value: _nanoseconds(value or "off"), return_type=str, when_used="json"),
    WithJsonSchema({"anyOf": [_DURATION_SCHEMA, {"type": "string", "enum": ["auto", "off"]}]}),
]
"""Time as Duration, converted to ns, or the word `auto`; the word `off` becomes 0."""


def size(text: str) -> int:
    """Convert a size such as `100 MB`, `10GB` or `64 MiB` to bytes; raise ValueError with an example."""
    number, unit = split(text, "a size", _SIZE_BYTES, "10 GB")
    return round(Fraction(number) * _SIZE_BYTES[unit])


def _part(value: object) -> object:
    if isinstance(value, tuple):  # was read before
        return value
    units = {**_SIZE_BYTES, **DURATION_NS}
    number, unit = split(value, "a size or a duration", units, "100 MB or 10 min")
    amount = round(Fraction(number) * units[unit])
    if not 0 <= amount <= LONGEST_NS:
        raise validation_error(
            f"{value!r} is out of range", "write a size or a duration such as 100 MB or 10 min"
        )
    return ("bytes" if unit in _SIZE_BYTES else "ns", amount)


SizeOrDuration = Annotated[
    tuple[Literal["bytes", "ns"], int],
    BeforeValidator(_part),
    PlainSerializer(
        lambda value: f"{value[1] / 1000!r} kB" if value[0] == "bytes" else f"{value[1]} ns",
        return_type=str,
        when_used="json",
    ),
    WithJsonSchema(text_schema("100 MB", {**_SIZE_BYTES, **DURATION_NS})),
]
"""Size in bytes from `100 MB`, or time in ns from `10 min`; the first element says which, `bytes` or `ns`."""
