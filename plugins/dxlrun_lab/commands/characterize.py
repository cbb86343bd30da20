"""`dxlrun characterize`: response, speed, dead band, highest rate and longest command gap of servos."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import show_json, show_parts
from dxlrun.tooling.verbs import check_report, write_report
from dxlrun_lab.commands.on_robot import DEFAULTS, ExperimentOptions, Words, run_on_robot


def characterize(
    *words: Words,
    measure: Annotated[
        tuple[Literal["rate", "response", "speed", "dead_band", "gap"], ...],
        Parameter(negative=(), show_default=False),
    ] = (),
    tolerance: str = "1deg",
    options: ExperimentOptions = DEFAULTS,
) -> int:
    """Measure the performance of servos: response, speed, dead band, highest rate, longest gap of commands.

    The named joints move one after the other within their ranges, as fast as they can. With a robot file, a
    run is started and stopped. Without one, the running robot is used. Any key or Ctrl-C ends the measurement
    and shows the results so far.

    Parameters
    ----------
    words
        Joints, after a robot file with its arguments. Default robot: the running one.
    measure
        Quantity to measure. Can be given several times. Default: all five.
    tolerance
        Largest deviation of a joint from its path during a gap of commands.
    """
    from dxlrun.tooling.verbs import angle
    from dxlrun_lab.characterize.characterization_tables import parts, results
    from dxlrun_lab.characterize.procedure import MEASUREMENTS, CharacterizationExperiment

    try:
        allowed = angle(tolerance)
    except ValueError as error:
        raise InputError(f"--tolerance {tolerance}: {error}") from None
    if not 0 < allowed <= math.radians(_MOST_DEG):
        raise InputError(f"--tolerance {tolerance}: give an angle above 0 and up to {_MOST_DEG:g} deg")
    if options.report is not None:
        check_report(options.report)
    ran = run_on_robot(CharacterizationExperiment(measure or MEASUREMENTS, allowed), words, options)
    if ran.result is None:
        if options.as_json:
            show_json(None, code=ran.exit_code, errors=ran.failures)
        return ran.exit_code
    if options.report is not None:
        from dxlrun_lab.characterize.characterization_page import page

        write_report(options.report, page(ran.result))
    if options.as_json:
        show_json(results(ran.result), code=ran.exit_code, errors=ran.failures)
    else:
        show_parts(*parts(ran.result))
        if ran.log is not None:
            show_parts(f"log: {ran.log}")
        if options.report is not None:
            show_parts(f"report: {options.report}")
    return ran.exit_code


_MOST_DEG = 45.0
