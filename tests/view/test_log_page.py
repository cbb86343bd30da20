"""The page of a log: what it shows is what the log has; what is wrong is refused in a sentence."""

import socket
from contextlib import ExitStack

import numpy as np
import pytest

import dxlrun_view.recorded_robot as module
from dxlrun import open_log
from dxlrun.log import log_reader
from dxlrun.remote.network.listener import MOST_UNPROVED
from dxlrun_view.page_server import mesh_file
from dxlrun_view.recorded_robot import RecordedRobot

JOINT = "right_elbow_joint"


def test_columns_are_those_of_the_cycles(log, recorded, serve):
    served = serve(recorded)
    seen = served.look(
        shown=True, spans=[{"names": [f"{JOINT}/position"], "begin": 0, "end": 99, "points": 4000}]
    )
    shown = seen["shown"]
    assert not shown["live"]
    assert JOINT in shown["info"]["joints"]
    cycles = np.concatenate([part.cycles for part in open_log(log).slices()])
    (curve,) = seen["curves"][0]
    row = shown["info"]["joints"].index(JOINT)
    assert np.allclose(curve["value"], cycles["position"][:, row], atol=1e-6)
    assert np.allclose(curve["time"], (cycles["woken_ns"] - cycles["woken_ns"][0]) * 1e-9, atol=1e-6)
    middle = served.look(time=5.0)["moment"]
    place = shown["columns"].index(f"{JOINT}/goal_position")
    at = int(np.searchsorted(curve["time"], middle["time"]))
    assert middle["values"][place] == pytest.approx(cycles["goal_position"][at, row], abs=1e-6)
    assert seen["events"]
    assert served.ask("/urdf")[1].startswith(b"<?xml")


def test_fields_of_topics_are_drawn(recorded, serve):
    served = serve(recorded)
    fields = served.look(shown=True)["shown"]["fields"]
    assert "/imu/imu:orientation.w" in fields
    spans = [{"names": ["/imu/imu:orientation.w", "/imu/imu:nothing", "nonsense"], "begin": 0, "end": 9}]
    first, *others = served.look(spans=spans)["curves"][0]
    assert len(first["value"]) > 100
    assert [one["value"] for one in others] == [[], []]


def test_a_long_log_is_thinned_and_keeps_its_worst_cycles(log, monkeypatch):
    whole = RecordedRobot(log).describe_page()
    monkeypatch.setattr(module, "MOST_CYCLES", 100)
    monkeypatch.setattr(log_reader, "SLICE_BYTES", 1)
    thin = RecordedRobot(log)
    shown = thin.describe_page()
    assert shown.every in (4, 8)
    assert shown.span == pytest.approx(whole.span, abs=0.2)
    assert shown.marks == whole.marks
    kept = thin.curve("loop/cycle", 0.0, 99.0, 4000).value
    assert set(np.diff(np.array(kept, float))) == {float(shown.every)}


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example:80"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"X_Dxlrun_Token": "wrong"}, 401),
        ({"X_Dxlrun_Token": ""}, 401),
        ({}, 200),
    ],
)
def test_the_page_answers_itself_alone(recorded, serve, headers, status):
    served = serve(recorded, control=True)
    assert served.ask("/look", {}, **headers)[0] == status
    assert served.ask("/urdf", None, **headers)[0] == status
    answer = served.ask("/act", {"verb": "halt"}, **headers)
    assert answer[0] == (409 if status == 200 else status)
    own = served.ask("/look", {}, Origin=f"http://127.0.0.1:{served.port}", Host=f"localhost:{served.port}")
    assert own[0] == 200


def test_idle_connections_do_not_keep_the_browser_out(recorded, serve):
    served = serve(recorded)
    with ExitStack() as opened:
        for _ in range(3 * MOST_UNPROVED):
            opened.enter_context(socket.create_connection(("127.0.0.1", served.port)))
        assert served.look()["moment"]


def test_mesh_is_found_beside_the_robot_or_in_its_package(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/a.stl").write_bytes(b"solid")
    (tmp_path / "robot").mkdir()
    found = tmp_path / "meshes/a.stl"
    assert mesh_file(tmp_path, "meshes/a.stl") == found
    assert mesh_file(tmp_path / "robot", f"package://{tmp_path.name}/meshes/a.stl") == found
    assert mesh_file(tmp_path, "package://other/meshes/b.stl") is None


def test_mesh_that_the_urdf_does_not_name_is_not_served(recorded, serve, tmp_path, monkeypatch):
    """In the folder of the robot, and in those next to and above it."""
    folder = tmp_path / "robot"
    for path in (
        "robot/named.stl",
        "robot/other.stl",
        "robot/urdf/other.dae",
        "beside/other.obj",
        "other.stl",
    ):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_bytes(path.encode())
    monkeypatch.setattr(RecordedRobot, "folder", folder)
    monkeypatch.setattr(recorded, "urdf", lambda: '<robot><mesh filename="named.stl"/></robot>')
    served = serve(recorded)
    assert served.ask("/mesh?name=named.stl") == (200, b"robot/named.stl")
    others = (
        "/etc/passwd",
        "../../etc/passwd",
        "robot.yaml",
        "",
        "other.stl",
        "other.dae",
        "../beside/other.obj",
        "../other.stl",
        "package://beside/other.obj",
    )
    for name in (*others, str(tmp_path / "other.stl"), "package://robot/named.stl", "./named.stl"):
        assert served.ask(f"/mesh?name={name}")[0] == 404, name
