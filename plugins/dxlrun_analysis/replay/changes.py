"""Changes: what a replay does otherwise than the run, on purpose: parameters, arguments of the robot file."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import yaml
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun import InputError
from dxlrun.control.controllers.plugins import mismatches
from dxlrun.description.document import confined
from dxlrun.description.problems import sentences_of
from dxlrun.tooling.plans import ControllerPlan, JointPlan, LoopPlan
from dxlrun.tooling.robots import PlugIns, compile_robot, read_robot
from dxlrun.tooling.verbs import suggestion
from dxlrun_analysis.replay.recorded import RecordedPlan

_MOST_SENTENCES = 20


class Setting(msgspec.Struct, frozen=True):
    """One parameter with another value: `--set left_arm.tolerances.path=0.1`."""

    controller: str
    parameter: tuple[str, ...]
    value: object

    @classmethod
    def parse(cls, text: str) -> Setting:
        """Read `CONTROLLER.PARAMETER=VALUE`; the value is written as in the robot file. Raises InputError."""
        place, sign, value = text.partition("=")
        controller, *parameter = place.strip().split(".")
        if not sign or not parameter or not all((controller, *parameter)):
            raise InputError(f"{text!r} sets nothing; write --set CONTROLLER.PARAMETER=VALUE")
        try:
            return cls(controller, tuple(parameter), yaml.safe_load(value))
        except yaml.YAMLError as error:
            raise InputError(
                f"the value {value!r} of {place} is no YAML ({getattr(error, 'problem', None) or error}); "
                "write it as in the robot file"
            ) from error


def with_settings(loop: LoopPlan, settings: Sequence[Setting], plugins: PlugIns) -> LoopPlan:
    """Return the plan with these parameters. Raises InputError for what is not there or does not fit."""
    names = tuple(controller.name for controller in loop.controllers)
    joints = {joint.name: joint for joint in loop.joints}
    controllers = {controller.name: controller for controller in loop.controllers}
    for setting in settings:
        if setting.controller not in controllers:
            raise InputError(
                f"--set {setting.controller}: the log has no such controller; "
                f"{suggestion(setting.controller, names)}"
            )
        controllers[setting.controller] = _changed(controllers[setting.controller], setting)
    for name in {setting.controller for setting in settings}:
        controllers[name] = _asked(f"--set {name}", controllers[name], joints, plugins, loop.urdf)
    return replace(loop, controllers=tuple(controllers[name] for name in names))


def with_changed_code(loop: LoopPlan, then: LoopPlan, plugins: PlugIns) -> LoopPlan:
    """Return the plan with what controllers of changed files claim now; raises InputError for a misfit.

    `then`: the loop of the run.
    """
    joints = {joint.name: joint for joint in loop.joints}
    return replace(
        loop,
        controllers=tuple(
            now
            if now.distribution == before.distribution
            else _asked(f"--code current: {now.name}", now, joints, plugins, loop.urdf)
            for before, now in zip(then.controllers, loop.controllers, strict=True)
        ),
    )


def _changed(plan: ControllerPlan, setting: Setting) -> ControllerPlan:
    parameters = json.loads(plan.parameters)
    place = parameters
    for key in setting.parameter[:-1]:
        place = place.setdefault(key, {})
        if not isinstance(place, dict):
            raise InputError(f"--set {plan.name}.{'.'.join(setting.parameter)}: {key} has no parts")
    place[setting.parameter[-1]] = setting.value
    return replace(plan, parameters=json.dumps(parameters, default=str))


def _asked(
    change: str, plan: ControllerPlan, joints: Mapping[str, JointPlan], plugins: PlugIns, urdf: str | None
) -> ControllerPlan:
    """Let the controller check its parameters after a change, and return what it claims then."""
    offer = plugins.controllers.get(plan.type)
    if offer is None:
        return plan  # the manager reports it
    try:
        parameters = offer.controller.Parameters.model_validate_json(plan.parameters)
        interfaces = offer.controller.interfaces(parameters, tuple(joints))
    except ValidationError as error:
        wrong = sentences_of(error, plan.name, offer.controller.Parameters, _MOST_SENTENCES)
        prefix = change.removesuffix(plan.name)
        raise InputError("\n".join(f"{prefix}{sentence}" for sentence in wrong)) from error
    except Exception as error:  # foreign code: one sentence instead of its traceback
        raise InputError(f"{change}: {type(error).__name__}: {error}") from error
    unknown = [joint for joint in interfaces.joints if joint not in joints]
    if unknown or len(set(interfaces.joints)) != len(interfaces.joints):
        what = f"joint {unknown[0]}, which the log does not have" if unknown else "a joint twice"
        raise InputError(f"{change}: the controller would want {what}")
    own = [joints[joint] for joint in interfaces.joints]
    try:
        found = mismatches(offer.controller, parameters, interfaces.motors, own, urdf)
    except Exception as error:  # as above
        raise InputError(f"{change}: {type(error).__name__}: {error}") from error
    if found:
        raise InputError(f"{change}: the controller {found[0].what}")
    changed = replace(
        plan,
        joints=interfaces.joints,
        command=interfaces.command,
        reference=interfaces.reference,
        reads=interfaces.reads,
        provides=interfaces.provides,
        device_commands=interfaces.device_commands,
    )
    if changed.references != plan.references:
        raise InputError(f"{change}: the controller would export other references than those of the log")
    if changed.provides != plan.provides:
        raise InputError(f"{change}: the controller would provide other states than those of the log")
    return changed


def with_arguments(plan: RecordedPlan, loop: LoopPlan, arguments: Mapping[str, str]) -> LoopPlan:
    """Return the loop of the log's robot file with other arguments; its cycles and commands stay.

    Raises InputError when the file does not compile with them, or gives a loop for which the recorded inputs
    are none.
    """
    if not arguments:
        return loop
    same = _compiled(plan, plan.arguments)
    if (same.joints, same.controllers) != (plan.loop.joints, plan.loop.controllers):
        raise InputError(
            "the robot file in the log no longer gives the plan that was run (other versions, or servos "
            "whose models are known only at a start): its arguments cannot be changed; --set can"
        )
    other = _compiled(plan, {**plan.arguments, **arguments})
    if other.period_ns != loop.period_ns:
        raise InputError(
            f"the arguments change the loop's period from {loop.period_ns} ns to {other.period_ns} ns, but "
            "the recorded inputs came with the old one; leave the rate as it is"
        )
    names = [tuple(one.name for one in each) for each in (other.joints, loop.joints)]
    others = [tuple(one.name for one in each) for each in (other.controllers, loop.controllers)]
    if names[0] != names[1] or others[0] != others[1]:
        raise InputError(
            "the arguments change which joints or controllers there are; the log has the old ones"
        )
    if other.references != loop.references:
        raise InputError("the arguments change which references there are; the log has the old ones")
    if other.source_states != loop.source_states:
        raise InputError(
            "the arguments change which devices, sensors and states there are; the log has the old ones"
        )
    return replace(loop, joints=other.joints, controllers=other.controllers)


def _compiled(plan: RecordedPlan, arguments: Mapping[str, str]) -> LoopPlan:
    """Compile the files of the log, in a directory of their own."""
    name = Path(plan.source_file).name
    with tempfile.TemporaryDirectory(prefix="dxlrun-replay-") as directory:
        root = Path(directory).resolve()
        home = root.joinpath(*["up"] * 8)  # a file may include one beside or above its own directory
        files = {name: plan.source_text, **plan.included}
        for relative, text in files.items():
            _write(root, home / relative, text)
        try:
            with confined(root):
                description = read_robot(home / name, arguments)
                urdf = plan.loop.urdf
                if urdf is not None and description.robot.model is not None:
                    _write(root, home / description.robot.model.urdf, urdf)
                return compile_robot(description, []).plan.loop
        except InputError as error:
            raise InputError(str(error).replace(f"{home}/", "")) from error


def _write(root: Path, path: Path, text: str) -> None:
    """Write one file of the log. Raises InputError for a name that leads out of the directory."""
    place = Path(path).resolve()
    if not place.is_relative_to(root):
        raise InputError(
            f"the log has a file {path.name} outside of its robot's directory; it is not written"
        )
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
