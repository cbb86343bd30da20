"""Result of `dxlrun identify` as tables and sentences, for terminal and HTML report."""

from __future__ import annotations

import math

from dxlrun.tooling.output import Cell, Column, Part, Sentence, Table
from dxlrun_lab.identify.result import IdentifiedServo, IdentifiedValue

_NAMES = {
    "torque_constant_with_viscous_friction": "torque constant, with viscous friction",
    "torque_per_measured_ampere": "torque per measured ampere",
    "load_gravity": "weight, horizontal",
    "load_gravity_angle": "angle of the weight",
}
_MODELS = {
    "m1": "Coulomb and viscous friction",
    "m3": "load-dependent friction",
    "m4": "load-dependent friction with Stribeck effect",
}


def parts(result: IdentifiedServo) -> tuple[Part, ...]:
    """Return the result of one joint: the table of figures, and sentences on scale, fit and remarks."""
    degrees = math.degrees(result.position_rms), math.degrees(result.held_out_rms)
    lines = [
        f"{'* ' if result.scale == 'manual' else ''}{result.scale_sentence}",
        f"friction model {result.friction_model} ({_MODELS[result.friction_model]}): chosen by BIC and "
        f"held-out error from {_candidates(result)}",
        f"error of the model: {degrees[0]:.3f} deg RMS in {result.seconds:.0f} s, {degrees[1]:.3f} deg in "
        "the held-out seconds",
        "intervals are linearised; residuals count as correlated within a second",
        *result.notes,
    ]
    return (values_table(result), *(Sentence(f"  {line}") for line in lines))


def values_table(result: IdentifiedServo) -> Table:
    """Return the table of a joint's figures with their intervals and expected values."""
    columns = (
        Column("", "name"),
        Column("value"),
        Column("+- 95 %"),
        Column("unit", "name"),
        Column("expected"),
        Column("differs"),
    )
    return Table.from_rows(
        f"{result.joint} ({result.model})", columns, (_row(value) for value in result.values)
    )


def _row(value: IdentifiedValue) -> tuple[Cell | str | None, ...]:
    name, expected = _NAMES.get(value.name, value.name.replace("_", " ")), value.expected
    name += " *" if value.by_manual else ""
    shown = None if expected is None else f"{expected:.4g}"
    if value.half is None:
        return name, _digits(value.value, abs(value.value) / 1000), "taken", value.unit, shown, ""
    if not value.identified and value.name not in ("delay", "load_gravity_angle"):
        highest = abs(value.value) + value.half
        return name, Cell(f"below {highest:.2g}", "warning"), "not told", value.unit, shown, ""
    part = None if not expected else f"{value.value / expected - 1:+.1%}"
    return name, _digits(value.value, value.half), f"{value.half:.2g}", value.unit, shown, part


def _digits(value: float, half: float) -> str:
    """Format a value with its significant digits by the half-width, and one more."""
    if half <= 0.0 or not math.isfinite(half):
        return f"{value:.4g}"
    return f"{value:.{max(0, min(8, 1 - math.floor(math.log10(half))))}f}"


def _candidates(result: IdentifiedServo) -> str:
    best = min(bic for _, bic, _ in result.candidates)
    return ", ".join(
        f"{name} ({math.degrees(held_out):.3f} deg, BIC {'best' if bic == best else f'+{bic - best:.0f}'})"
        for name, bic, held_out in result.candidates
    )
