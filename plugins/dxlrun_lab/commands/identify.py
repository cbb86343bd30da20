"""`dxlrun identify`: a servo's motor, gear and control, from a run that excites it or from an earlier log.

dxlrun identify robots/single_joint.yaml joint --output joint.motor.yaml
dxlrun identify joint --recorded logs/single_joint.mcap
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.output import check_target, err, print_error, show_json, show_parts, write_target
from dxlrun.tooling.verbs import Seconds, check_report, missing_extra, write_report
from dxlrun_lab.commands.on_robot import DEFAULTS, ExperimentOptions, Words

if TYPE_CHECKING:
    from dxlrun_lab.identify.identification import JointResult, Options
    from dxlrun_lab.identify.result import IdentifiedServo

Number = Annotated[float | None, Parameter(show_default=False)]
_LONGEST_S = 3600.0


def identify(
    *words: Words,
    recorded: Path | None = None,
    duration: Seconds = 60.0,
    load_inertia: Number = None,
    load_gravity: Number = None,
    voltage: Number = None,
    output: Path | None = None,
    options: ExperimentOptions = DEFAULTS,
) -> int:
    """Identify the parameters of servos: torque constant, resistance, inertia, friction, gain, delay.

    Each named joint moves through its range for the --duration, and a servo model is fitted to the recording.
    The results have 95 % intervals.

    Parameters
    ----------
    words
        Joints, after a robot file with its arguments. Default robot: the running one.
    recorded
        Log of an earlier run to evaluate. Nothing is moved then. Without joints, all joints of the log are
        evaluated.
    duration
        Duration of the motion of each joint, s.
    load_inertia
        Known inertia of the load, kg m^2. The rest of the identified inertia is the motor's own.
    load_gravity
        Known torque of the weight of the horizontal load, Nm. It sets the scale of all torques. Default
        scale: the measured current, or the stall torque of the manual.
    voltage
        Supply voltage, V. Default: the voltage that the servo reports.
    output
        Output file for the motor file of the joint, which the key `motor` in the robot file names.
    """
    from dxlrun_lab.commands.on_robot import RobotFileArguments, run_on_robot

    _check(duration, load_inertia, load_gravity, voltage)
    joints = RobotFileArguments.parse_words(words).joints
    if output is not None:
        _check_output(output, joints)
    if options.report is not None:
        check_report(options.report)
    if missing := missing_extra("identify", "identify", "scipy"):
        raise InputError(missing)
    from dxlrun_lab.identify.identification import Identification, Options
    from dxlrun_lab.identify.result import KnownLoad

    chosen = Options(duration, load=KnownLoad(load_inertia, load_gravity), voltage=voltage)
    if recorded is not None:
        results, robot, code, log = _of_log(recorded, words, chosen, options), recorded.name, 0, None
        failures: tuple[str, ...] = ()
    else:
        ran = run_on_robot(Identification(chosen), words, options)
        results, robot, code, log = ran.result or (), ran.robot, ran.exit_code, ran.log
        failures = ran.failures
    found = [each for each in results if each.identified is not None]
    refusals = [each.refusal for each in results if each.identified is None]
    for refusal in () if options.as_json else refusals:
        print_error(f"dxlrun: {refusal}")
    if output is not None:
        for each in results:  # of one joint: _check_output
            if each.identified is not None:
                _write(output, each.joint, each.identified)
    if options.report is not None and found:
        from dxlrun_lab.identify.identification_page import page

        write_report(options.report, page(robot, found))
    code = 2 if recorded is not None and results and not found else code or bool(refusals)
    if options.as_json:
        show_json([each.identified for each in found], code=code, errors=[*failures, *refusals])
    else:
        _show(found, options, log, output)
    return code


def _of_log(
    log: Path, words: tuple[str, ...], chosen: Options, options: ExperimentOptions
) -> tuple[JointResult, ...]:
    from dxlrun.tooling.logs import read_log
    from dxlrun_lab.identify.identification import from_log

    if not log.exists():
        raise InputError(f"log {log} not found; a run prints the path of its log when it ends")
    if (
        options.virtual
        or options.robot
        or options.range
        or any(":=" in word or "." in word for word in words)
    ):
        raise InputError("--recorded evaluates a log, without a robot; name joints only")
    with err().status("computing the result"):
        return from_log(read_log(log), words, chosen)


def _check(duration: float, inertia: float | None, gravity: float | None, voltage: float | None) -> None:
    if not 0.0 < duration <= _LONGEST_S:
        raise InputError(
            f"--duration {duration:g}: give the time of motion of each joint, up to {_LONGEST_S:g} s"
        )
    if inertia is not None and not 0.0 <= inertia < 1e3:
        raise InputError(f"--load-inertia {inertia:g}: give the inertia of the load in kg m^2, 0 or more")
    if gravity is not None and not 0.0 < gravity < 1e4:
        raise InputError(f"--load-gravity {gravity:g}: give the torque of the weight in Nm, more than 0")
    if voltage is not None and not 1.0 <= voltage <= 60.0:
        raise InputError(f"--voltage {voltage:g}: give the voltage of the supply, 1 to 60 V")


def _check_output(target: Path, joints: tuple[str, ...]) -> None:
    """Raise InputError if the motor file of --output cannot be written, or several joints are named."""
    if len(joints) != 1:
        raise InputError("--output takes the motor file of one joint; name that joint only")
    check_target(target)


def _write(target: Path, joint: str, found: IdentifiedServo) -> None:
    from dxlrun.tooling.robots import motor_text

    comment = "\n".join((f"{joint}, by dxlrun identify.", f"{found.scale_sentence}.", *found.notes))
    write_target(target, motor_text(found.motor, found.uncertainty, comment=comment))


def _show(
    found: list[JointResult], options: ExperimentOptions, log: Path | None, output: Path | None
) -> None:
    from dxlrun_lab.identify.identification_tables import parts

    for each in found:
        if each.identified is not None:
            show_parts(*parts(each.identified))
    if log is not None:
        show_parts(f"\nlog: {log}")
    if options.report is not None and found:
        show_parts(f"report: {options.report}")
    if output is not None and found:
        show_parts(f"motor file: {output}")
