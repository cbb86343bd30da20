"""Logged plan: compiles the robot of a log again, with changed texts or controllers, for a replay."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import ValidationError

from dxlrun.compile.controller_entry import WrongEntry, compile_entry, require_fit
from dxlrun.compile.robot_compiler import CompiledRobot, compile_robot
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.description.document import confined
from dxlrun.description.form_problems import sentences_of
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan

_MOST_SENTENCES = 20


def compile_texts(
    files: Mapping[str, str], arguments: Mapping[str, str], urdf: str | None, without: Sequence[str] = ()
) -> CompiledRobot:
    """Compile a robot from the texts of its files, written into a temporary directory.

    Args:
        files: Texts by their paths relative to the robot file; the robot file is the first.
        arguments: Arguments of the robot file.
        urdf: Text of the URDF that the robot file names, or None.
        without: Joints that are omitted.

    Raises:
        InputError: The files do not compile, or one of them is outside the directory.
    """
    name = next(iter(files))
    with tempfile.TemporaryDirectory(prefix="dxlrun-replay-") as directory:
        root = Path(directory).resolve()
        home = root.joinpath(*["up"] * 8)  # A file may include files next to its own directory or above it.

        def shorten(text: str) -> str:
            return text.replace(f"{home}/", "")

        for relative, text in files.items():
            _write(root, home / relative, text)
        try:
            with confined(root):
                description = read_robot(home / name, arguments, without=without)
                if urdf is not None and description.robot.model is not None:
                    _write(root, home / description.robot.model.urdf, urdf)
                return compile_robot(description, [])
        except InputError as error:
            problems = [
                one._replace(mark=one.mark._replace(file=shorten(one.mark.file)), what=shorten(one.what))
                for one in error.problems
            ]
            raise InputError(problems or shorten(str(error))) from error


def _write(root: Path, path: Path, text: str) -> None:
    """Write a file below `root`; raise InputError for a path outside of `root`."""
    place = Path(path).resolve()
    if not place.is_relative_to(root):
        raise InputError(
            f"file {path.name} of the log is outside of the robot's directory and is not written"
        )
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)


def replan_controller(
    change: str, plan: ControllerPlan, joints: Mapping[str, JointPlan], plugins: PlugIns, urdf: str | None
) -> ControllerPlan:
    """Check a controller of a log with new parameters or code; return its plan with its new claims.

    Args:
        change: Start of the messages, which names the change.
        plan: The controller with its new parameters.
        joints: Plans of all joints by name.
        plugins: The types of controllers.
        urdf: Text of the robot's URDF, or None.

    Raises:
        InputError: The parameters are invalid, or the controller does not fit the robot of the log.
    """
    offer = plugins.controllers.get(plan.type)
    if offer is None:
        return plan  # the manager reports the missing type
    wrapping = {name for name, joint in joints.items() if joint.wrap}
    try:
        found = compile_entry(plan, offer, tuple(joints), wrapping=wrapping)
        require_fit(found, [joints[joint] for joint in found.plan.joints], joints, urdf, {})
    except ValidationError as error:
        wrong = sentences_of(error, plan.name, offer.controller.Parameters, _MOST_SENTENCES)
        prefix = change.removesuffix(plan.name)
        raise InputError("\n".join(f"{prefix}{sentence}" for sentence in wrong)) from error
    except WrongEntry as error:
        raise InputError(f"{change}: {error}") from error
    changed = found.plan
    if changed.references != plan.references:
        raise InputError(f"{change}: the exported references differ from the log")
    if changed.provides != plan.provides:
        raise InputError(f"{change}: the provided states differ from the log")
    return changed
