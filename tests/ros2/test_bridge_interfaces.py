"""The message packages of the bridge: their definitions, and the hashes by which ROS 2 tells types apart."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dxlrun.control.controllers.goal_registry import GoalStatus
from dxlrun.control.controllers.published_topics import OWN_PACKAGE
from dxlrun.log.schemas import FRAMES
from dxlrun.messages.declared import declared_message
from dxlrun_controllers.feed_forward import FeedForwardState
from dxlrun_controllers.gravity_compensation import GravityState
from dxlrun_controllers.gripper_controller import GripperState
from dxlrun_controllers.motions.ilc_controller import LearnedRepetition
from dxlrun_controllers.pid_controller import PidState
from dxlrun_controllers.thermal_governor import ThermalState

DISTRIBUTION = Path(__file__).parents[2] / "plugins/dxlrun_ros2"
OWN = (FeedForwardState, GravityState, GripperState, LearnedRepetition, PidState, ThermalState, GoalStatus)


def hash_of(name: str) -> str:
    """Return the RIHS01 hash of a message of the bridge, by another implementation of it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    package, _, kind = name.split("/")
    store.register(
        get_types_from_msg((DISTRIBUTION / f"interfaces/{package}/msg/{kind}.msg").read_text(), name)
    )
    return store.hash_rihs01(name)


@pytest.mark.parametrize("message", OWN)
def test_the_bridge_has_the_messages_that_standard_controllers_publish(message: type) -> None:
    """Their bytes are published as they are: another definition would be read wrongly."""
    declared = declared_message(message, OWN_PACKAGE).type
    assert hash_of(declared.name) == declared.type_hash


def test_no_other_message_of_ours_is_there() -> None:
    files = {path.stem for path in (DISTRIBUTION / "interfaces" / OWN_PACKAGE / "msg").iterdir()}
    assert files == {message.__name__ for message in OWN}


def test_the_transforms_have_the_hash_of_tf2_msgs() -> None:
    """As geometry2 has it: rosbags' own definition, and what `ros2 topic info -v /tf` prints on Jazzy."""
    published = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    assert get_typestore(Stores.ROS2_JAZZY).hash_rihs01("tf2_msgs/msg/TFMessage") == published
    assert hash_of("tf2_msgs/msg/TFMessage") == FRAMES.type_hash == published


def test_the_state_of_a_trajectory_controller_has_the_hash_of_control_msgs() -> None:
    """As `ros2 topic info -v` prints it of a controller of ros2_control."""
    published = "RIHS01_51d8dd89cc624cbe9daaeeb4d80d6de9b86168ffdc3be41fefc0953e3c26e480"
    assert hash_of("control_msgs/msg/JointTrajectoryControllerState") == published


def test_the_build_says_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DISTRIBUTION))
    sys.modules.pop("hatch_build", None)  # that of the core has the same name
    build: ModuleType = __import__("hatch_build")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"tf2_msgs has no wheel .* gcc and g\+\+ and Python's headers"):
        build._compile("tf2_msgs", tmp_path, tmp_path, tmp_path / "x.so", tmp_path)
    sys.modules.pop("hatch_build", None)
