"""Robots: robot and motion files and URDFs, read and compiled.

Files are read into descriptions, which keep the place of each value for messages; a compiled robot has the
plan. Each step raises `InputError` with all problems of the files.

    from pathlib import Path

    from dxlrun.tooling.robots import compile_robot, read_robot

    plan = compile_robot(read_robot(Path("robots/bioloid_torso.yaml"), {"port": "sim"}), []).plan
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.compile.joints.compiled_joints import CompiledJoint as CompiledJoint
    from dxlrun.compile.joints.described_servos import find_unknown_servos as find_unknown_servos
    from dxlrun.compile.logged_plan import compile_texts as compile_texts
    from dxlrun.compile.logged_plan import replan_controller as replan_controller
    from dxlrun.compile.motions import TRAJECTORY as TRAJECTORY
    from dxlrun.compile.motions import command_kind as command_kind
    from dxlrun.compile.robot_compiler import CompiledRobot as CompiledRobot
    from dxlrun.compile.robot_compiler import compile_robot as compile_robot
    from dxlrun.control.controllers.plugin_loading import PlugIns as PlugIns
    from dxlrun.control.controllers.plugin_loading import load_plugins as load_plugins
    from dxlrun.control.controllers.single_files import published_by as published_by
    from dxlrun.description.document import read_file as read_file
    from dxlrun.description.frames.tree import FrameTree as FrameTree
    from dxlrun.description.including import Source as Source
    from dxlrun.description.including import read_sources as read_sources
    from dxlrun.description.joints.motor_file import motor_text as motor_text
    from dxlrun.description.motion import parse_motion as parse_motion
    from dxlrun.description.motion import read_motion as read_motion
    from dxlrun.description.reading import Description as Description
    from dxlrun.description.reading import Replacement as Replacement
    from dxlrun.description.reading import read_robot as read_robot
    from dxlsim.geometry.transform import Transform as Transform
    from dxlsim.geometry.transform import conjugate as conjugate
    from dxlsim.geometry.transform import from_rpy as from_rpy
    from dxlsim.geometry.transform import product as product
    from dxlsim.geometry.transform import rotated as rotated
    from dxlsim.geometry.transform import rotation_about as rotation_about
    from dxlsim.geometry.urdf import Urdf as Urdf
    from dxlsim.geometry.urdf import UrdfJoint as UrdfJoint
    from dxlsim.geometry.urdf import read_urdf as read_urdf
    from dxlwire.bus_plan import SIMULATED as SIMULATED
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
