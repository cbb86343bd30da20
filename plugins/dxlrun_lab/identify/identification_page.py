"""HTML report of `dxlrun identify`: table, and plots of fit and residuals, for each joint."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element

import numpy as np
from matplotlib.figure import Figure

from dxlrun.tooling.html import document, footer, header, paragraph, section, table_element
from dxlrun.tooling.output import Sentence
from dxlrun_lab.figures.drawing import (
    BLUE,
    MUTED,
    ORANGE,
    PURPLE,
    draw_figure,
    reduced,
)
from dxlrun_lab.identify.fit import FitCurve
from dxlrun_lab.identify.identification import JointResult
from dxlrun_lab.identify.identification_tables import parts, values_table
from dxlrun_lab.identify.result import IdentifiedServo

_DETAIL_S = 4.0


def page(robot: str, results: Sequence[JointResult]) -> str:
    """Return the HTML report of all identified joints of a robot or log. Needs matplotlib."""
    found = [(each, each.identified) for each in results if each.identified is not None]
    top = header(
        f"Servos of {robot}",
        "Identified by dxlrun identify",
        "Identified: " + ", ".join(result.joint for _, result in found),
        [f"{result.joint}: {result.scale_sentence}." for _, result in found],
        good=True,
        key_numbers=[
            (f"{result.joint}, held out", f"{result.held_out_rms * 1e3:.2f} mrad") for _, result in found
        ],
    )
    sections = [_section(number, each, result) for number, (each, result) in enumerate(found)]
    end = footer("The element with id='report' contains the numbers of this page as JSON.")
    return document(f"{robot}: identified servos", top, sections, end, [result for _, result in found])


def _section(number: int, each: JointResult, result: IdentifiedServo) -> Element:
    texts = [part.text.strip() for part in parts(result) if isinstance(part, Sentence)]
    elements: list[Element] = [table_element(values_table(result)), *map(paragraph, texts)]
    if each.position is not None:
        elements += [_fit(number, result, each.position), _detail(number, result, each.position)]
    return section(f"joint-{number}", result.joint, elements)


def _fit(number: int, result: IdentifiedServo, curve: FitCurve) -> Element:
    def draw_fit(sheet: Figure) -> None:
        above, below = sheet.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        above.plot(*reduced(curve.time_s, curve.measured), color=BLUE, label="measured")
        above.plot(*reduced(curve.time_s, curve.simulated), color=ORANGE, linewidth=0.8, label="model")
        above.set_ylabel("position, rad")
        above.legend(loc="upper right")
        left = (curve.measured - curve.simulated) * 1e3
        for held, colour, name in ((False, PURPLE, "fitted"), (True, MUTED, "held out")):
            some = np.where(curve.held_out == held, left, np.nan)
            below.plot(*reduced(curve.time_s, some), color=colour, linewidth=0.8, label=name)
        below.set_ylabel("measured - model, mrad")
        below.set_xlabel("time of the run, s")
        below.legend(loc="upper right")

    rms, held_out = result.position_rms * 1e3, result.held_out_rms * 1e3
    return draw_figure(
        f"fit-{number}",
        f"{result.joint}: fit and residual",
        f"Position in rad and the difference in mrad over the time in s; {rms:.2f} mrad RMS.",
        "The model is simulated from the commands alone, second by second; every fifth second was held out "
        f"of the fit. The residual is {rms:.2f} mrad RMS, and {held_out:.2f} mrad in the held-out seconds.",
        4.0,
        draw_fit,
    )


def _detail(number: int, result: IdentifiedServo, curve: FitCurve) -> Element:
    """Draw measured and simulated positions in the four seconds in which the joint was fastest."""
    speed = np.abs(np.gradient(curve.measured, np.maximum(curve.time_s, np.arange(len(curve.time_s)) * 1e-9)))
    middle = float(curve.time_s[int(np.argmax(np.convolve(speed, np.ones(50), mode="same")))])
    near = np.abs(curve.time_s - middle) <= _DETAIL_S / 2

    def draw_detail(sheet: Figure) -> None:
        axes = sheet.subplots()
        axes.plot(curve.time_s[near], curve.measured[near], color=BLUE, label="measured")
        axes.plot(curve.time_s[near], curve.simulated[near], color=ORANGE, linewidth=0.9, label="model")
        axes.set_ylabel("position, rad")
        axes.set_xlabel("time of the run, s")
        axes.legend(loc="upper right")

    return draw_figure(
        f"detail-{number}",
        f"{result.joint}: its fastest {_DETAIL_S:g} s",
        f"Position in rad over {_DETAIL_S:g} s.",
        "Where the voltage saturates, the motor's own dynamics show.",
        2.6,
        draw_detail,
    )
