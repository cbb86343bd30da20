"""HTML page with the result and the figures of `dxlrun characterize`. Needs matplotlib."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np

from dxlrun.tooling.html import document, footer, header, paragraph, section, table_element
from dxlrun.tooling.output import counted
from dxlrun_lab.characterize import dead_band, rates, response, speeds
from dxlrun_lab.characterize.characterization_tables import format_figure, results, table
from dxlrun_lab.characterize.joint_figure import JointFigure
from dxlrun_lab.characterize.procedure import CharacterizationResult, JointCharacteristics
from dxlrun_lab.figures.servo_figures import (
    Points,
    ValueLine,
    curves_drawing,
    points_drawing,
)

_TITLE = "Servo characteristics"


def page(found: CharacterizationResult) -> str:
    """Return the HTML page of a result: key figures, and for each joint a table and plots."""
    measured = [one for joint in found.joints for one in joint.figures]
    known = sum(one.value is not None for one in measured)
    keys = [(joint.joint.name, one) for joint in found.joints for one in _key(joint)]
    top = header(
        _TITLE,
        found.robot,
        f"{known} of {counted(len(measured), 'figure', 'figures')} measured",
        [found.why] if found.why else [],
        not found.why,
        [(f"{one.name}, {name}", format_figure(one)) for name, one in keys],
    )
    sections = [
        section(joint.joint.name, joint.joint.plan.label, _parts(joint, found.tolerance))
        for joint in found.joints
    ]
    made = (
        "Made by dxlrun characterize. The element with id='report' contains the numbers of this page as "
        "JSON, in SI units."
    )
    return document(f"{_TITLE}: {found.robot}", top, sections, footer(made), results(found))


def _key(joint: JointCharacteristics) -> list[JointFigure]:
    names = (response.RISE, speeds.TOP, rates.NAME)
    return [one for one in joint.figures if one.name in names and one.value is not None]


def _parts(joint: JointCharacteristics, tolerance: float) -> Iterator[Element]:
    yield table_element(table(joint))
    for one in joint.figures:
        if one.value is None:
            yield paragraph(f"{one.name} is not measurable: {one.why}")
    yield from _drawings(joint, tolerance)


def _drawings(joint: JointCharacteristics, tolerance: float) -> Iterator[Element]:
    name = joint.joint.name
    by_name = {one.name: one for one in joint.figures if one.value is not None}
    if joint.steps:
        marks = [
            mark
            for key in (response.ONSET, response.RISE)
            if (mark := _mark(by_name.get(key), key, 1e3)) is not None
        ]
        curves = [(1e3 * step.time, np.degrees(step.way)) for step in joint.steps]
        height = math.degrees(joint.steps[0].height)
        text = (
            f"{counted(len(curves), 'step', 'steps')}, overlaid; dashed: the goal, and the response times "
            "with their intervals."
        )
        labels = ("time since the goal's packet, ms", "way, deg")
        yield curves_drawing(f"{name}-steps", "Step response", text, labels, curves, [height], marks)
    judged = [move for step in joint.moves if (move := speeds.move_of(step)) is not None]
    if judged:
        mark = _mark(by_name.get(speeds.TOP), speeds.TOP, 1.0)
        levels = [] if mark is None else [mark.value]
        text = "Slopes of the positions in moves through the range; dashed: the top speed."
        labels = ("time since the goal's packet, s", "speed, rad/s")
        curves = [(move.time, move.speed) for move in judged]
        yield curves_drawing(f"{name}-moves", "Speed of long moves", text, labels, curves, levels)
    if joint.rates:
        tried = [one for one in joint.rates if one.cycles]
        points = Points(
            "",
            np.array([one.rate for one in tried]),
            np.array([100 * (one.lost + one.too_long) / one.cycles for one in tried]),
            [bool(one.fault) for one in tried],
        )
        mark = _mark(by_name.get(rates.NAME), rates.NAME, 1.0)
        text = "Crossed: rate not kept. Cycles that only started late do not count: the machine causes them."
        yield points_drawing(
            f"{name}-rates",
            "Rates",
            text,
            [points],
            None,
            [] if mark is None else [mark],
            "rate, Hz",
            "lost or too long, % of cycles",
        )
    if joint.gaps:
        series = [
            Points(
                interface,
                np.array([1e3 * gap.gap_s for gap in tried]),
                np.array([math.degrees(gap.deviation) for gap in tried]),
                [not gap.kept(tolerance) for gap in tried],
            )
            for interface, tried in joint.gaps.items()
        ]
        text = (
            "Largest deviation from the path of a command in each cycle; crossed: too far, or at rest "
            "between commands."
        )
        level = (f"tolerance {math.degrees(tolerance):.2g} deg", math.degrees(tolerance))
        yield points_drawing(
            f"{name}-gaps", "Gaps between commands", text, series, level, [], "gap, ms", "deviation, deg"
        )
    if joint.band is not None and len(joint.band):
        band = by_name.get(dead_band.NAME)
        edge = [] if band is None or band.value is None else [math.degrees(band.value)]
        yield curves_drawing(
            f"{name}-band",
            "Dead band",
            "The goal moves slowly back and forth, with rests; dashed: the dead band to each side.",
            ("goal, deg", "goal - position, deg"),
            [(np.degrees(joint.band.goal), np.degrees(joint.band.goal - joint.band.position))],
            [side * each for each in edge for side in (-1, 1)],
        )


def _mark(one: JointFigure | None, name: str, factor: float) -> ValueLine | None:
    if one is None or one.value is None:
        return None
    return ValueLine(name.removeprefix("response "), factor * one.value, factor * (one.uncertainty or 0.0))
