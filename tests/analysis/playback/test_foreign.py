"""Foreign recordings, written by other libraries: MCAP by mcap-ros2-support, ROS 2 bags by rosbags."""

import sqlite3
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from dxlrun.errors import DxlrunError, InputError
from dxlrun.log.schemas import JOINT_STATE
from dxlrun_analysis.playback.recorded_motion import Stretch
from dxlrun_analysis.playback.sources import read_motion

STORE = get_typestore(Stores.ROS2_HUMBLE)
BEGAN_NS = 1_700_000_000_000_000_000
Row = tuple[str, int, int, str, float]  # Topic, time of recording, stamp, joint, position


def sine() -> tuple[np.ndarray, np.ndarray]:
    """Return times and positions of 2 s."""
    times = np.linspace(0.0, 2.0, 100)
    return times, 0.3 * np.sin(3 * times)


def state(t_ns: int, names: list[str], positions: list[float]) -> dict[str, Any]:
    stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
    return {
        "header": {"stamp": stamp, "frame_id": ""},
        "name": names,
        "position": positions,
        "velocity": [],
        "effort": [],
    }


def recorded(path: Path, rows: Iterable[Row], **options: Any) -> Path:
    """Write JointStates of one joint each, a stamp of 0 for none, and as many texts."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        kind = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE.text)
        text = writer.register_msgdef("std_msgs/msg/String", "string data")
        for topic, t_ns, stamp_ns, name, position in rows:
            if name:
                writer.write_message(topic, kind, state(stamp_ns, [name], [position]), log_time=t_ns)
            writer.write_message("/chatter", text, {"data": "x"}, log_time=t_ns)
        writer.finish()
    return path


@pytest.fixture
def foreign(tmp_path):
    """JointStates of two joints that come in turns on one topic."""
    rows: list[Row] = []
    for index, (time, position) in enumerate(zip(*sine(), strict=True)):
        t_ns = BEGAN_NS + round(time * 1e9)
        name, value = (("pan", position), ("tilt", -position))[index % 2]
        # without a stamp the time of recording counts
        stamp_ns, late_ns = (t_ns, 7_000_000) if index % 3 else (0, 0)
        rows.append(("/joint_states", t_ns + late_ns, stamp_ns, name, value))
    return recorded(tmp_path / "foreign.mcap", rows, chunk_size=2000)


def test_joint_states_of_a_foreign_file(foreign):
    motion = read_motion(foreign)
    assert motion.joints == ("pan", "tilt")
    assert motion.what == ("states", "states")
    # from the first position of tilt to the last of pan
    assert motion.duration_s == pytest.approx(2.0 * 97 / 99, abs=1e-6)
    times = motion.begin_s + motion.time_s
    assert np.abs(motion.position[:, 0] - 0.3 * np.sin(3 * times)).max() < 1e-3
    assert np.abs(motion.position[:, 1] + 0.3 * np.sin(3 * times)).max() < 1e-3


def test_it_is_played_on_a_robot_with_other_names(foreign, place, dxlrun):
    words = ["replay", foreign, "--on", "pair.yaml", "--virtual", "--joint", "tilt", "--map", "tilt=pan"]
    done = dxlrun(*words)
    assert (done.code, "pair: played, 2.8 s of" in done.out) == (0, True), done
    assert "0 joints by sent goals, 1 by measured positions" in done.err


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_of_ros_2(tmp_path, storage):
    types = STORE.types
    path = tmp_path / "bag"
    with BagWriter(path, version=9, storage_plugin=storage) as bag:
        goals = bag.add_connection(
            "/arm/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", typestore=STORE
        )
        for start_s, ends in ((0.0, (0.0, 1.0)), (1.0, (0.25, 0.75))):
            write_trajectory(bag, goals, types, BEGAN_NS + round(start_s * 1e9), ends)
    motion = read_motion(path)
    assert motion.what == ("goals",)
    # the second replaces the first at 1 s, halfway to 1 rad; its points are 2 s apart
    assert np.interp([0.0, 0.5, 1.0, 2.0, 3.0], motion.time_s, motion.position[:, 0]) == pytest.approx(
        [0.0, 0.25, 0.25, 0.5, 0.75], abs=1e-5
    )


def write_trajectory(
    bag: BagWriter, connection: Any, types: Any, t_ns: int, ends: tuple[float, float]
) -> None:
    def point(seconds: int, position: float) -> Any:
        none = np.zeros(0)
        due = types["builtin_interfaces/msg/Duration"](seconds, 0)
        return types["trajectory_msgs/msg/JointTrajectoryPoint"](np.array([position]), none, none, none, due)

    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    message = types["trajectory_msgs/msg/JointTrajectory"](
        header, ["pan"], [point(2 * index, end) for index, end in enumerate(ends)]
    )
    bag.write(connection, t_ns, STORE.serialize_cdr(message, message.__msgtype__))


def test_a_joint_in_several_topics_needs_a_choice(tmp_path):
    both = (("/leader", 1), ("/follower", -1))
    times = [(index, BEGAN_NS + index * 10**7) for index in range(20)]
    rows = [(name, t_ns, t_ns, "pan", sign * index) for index, t_ns in times for name, sign in both]
    path = recorded(tmp_path / "two.mcap", rows)
    with pytest.raises(
        InputError, match=r"two.mcap: pan is in several topics \(/follower, /leader\); choose"
    ):
        read_motion(path)
    assert read_motion(path, topic="/leader").position[-1, 0] == 19
    with pytest.raises(
        InputError, match=r"JointTrajectory message in CDR on /nothing; its topics are /follower"
    ):
        read_motion(path, topic="/nothing")
    with pytest.raises(InputError, match="with --what goals; its topics are"):
        read_motion(path, what="goals")


def test_a_file_without_such_messages_is_refused_with_what_it_has(tmp_path):
    path = recorded(tmp_path / "chatter.mcap", [("", BEGAN_NS, 0, "", 0.0)])
    with pytest.raises(InputError, match=r"chatter.mcap: no motion: .* topics are /chatter \(std_msgs/msg/S"):
        read_motion(path)


def test_a_hole_is_named(tmp_path):
    times = [BEGAN_NS + index * 10**7 for index in (*range(100), *range(300, 400))]
    path = recorded(tmp_path / "hole.mcap", [("/joint_states", t_ns, t_ns, "pan", 0.0) for t_ns in times])
    with pytest.raises(InputError, match=r"no positions of pan from 0.990 s to 3.000 s; choose a stretch"):
        read_motion(path)
    assert read_motion(path, stretch=Stretch(3.0)).duration_s == pytest.approx(0.99)


@pytest.mark.parametrize("make", [lambda data: b"", lambda data: b"no recording", lambda data: data[:300]])
def test_empty_wrong_and_half_files_are_one_sentence(foreign, tmp_path, make):
    path = tmp_path / "wrong.mcap"
    path.write_bytes(make(foreign.read_bytes()))
    with pytest.raises(DxlrunError, match=r"^[^\n]*wrong.mcap[^\n]*$"):
        read_motion(path)


def test_every_cut_and_some_flips_are_read_as_far_as_they_can(foreign, tmp_path):
    """A chunk has 2000 bytes: behind the first one there is a motion."""
    data = foreign.read_bytes()
    path = tmp_path / "cut.mcap"
    rng = np.random.default_rng(1)
    longest = 0.0
    for index in range(40):
        changed = bytearray(data)
        if index % 2:
            changed = changed[: int(rng.integers(len(data)))]
        else:
            changed[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with suppress(DxlrunError):
            longest = max(longest, read_motion(path).duration_s)
    assert 1.5 < longest < 2.1


def test_wrong_bags_are_one_sentence(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    with pytest.raises(DxlrunError, match="bag"):
        read_motion(bag)
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with pytest.raises(InputError, match=r"not a ROS 2 bag: metadata.yaml is invalid"):
        read_motion(bag)
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [a.db3]}")
    with pytest.raises(InputError, match=r"the bag lacks a.db3"):
        read_motion(bag)
    (bag / "a.db3").write_bytes(b"")
    with pytest.raises(InputError, match=r"a.db3: neither MCAP nor sqlite3"):
        read_motion(bag)
    (bag / "a.db3").unlink()
    with sqlite3.connect(bag / "a.db3") as database:
        database.execute("CREATE TABLE other (id INTEGER)")
    with pytest.raises(InputError, match=r"a.db3 cannot be read to its end: no such table"):
        read_motion(bag)


def test_log_in_parts_or_in_a_bag_is_read_as_the_log(swing, tmp_path):
    parts = tmp_path / "parts"
    parts.mkdir()
    (parts / "part_0000.mcap").write_bytes(swing.read_bytes())
    (parts / "notes.txt").write_text("not of the log")
    whole = read_motion(swing)
    assert np.array_equal(read_motion(parts).position, whole.position)
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "log.mcap").write_bytes(swing.read_bytes())
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [log.mcap]}")
    motion = read_motion(bag, topic="/joint_states")
    assert motion.joints == whole.joints
    assert motion.what == ("states", "states")
    measured = read_motion(swing, what="states")
    there = np.interp(motion.time_s, measured.time_s, measured.position[:, 0])
    assert np.abs(there - motion.position[:, 0]).max() < np.radians(2)  # stamped when they were read
