"""Examples that are steered: odometry, followers and sums of references, against closed forms."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.virtual_run import VirtualRun

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"


def messages(path: Path, topic: str) -> list[Any]:
    """Messages of a topic of a log, as a ROS 2 tool decodes them."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [decoded.decoded_message for decoded in reader.iter_decoded_messages(topics=[topic])]


def test_a_base_drives_a_circle_and_knows_it(tmp_path):
    run = VirtualRun(ROBOTS / "diff_drive.yaml", tmp_path / "run.mcap", duration_s=8.0)
    for number in range(60):
        run.command(100 + 100 * number, "base", "velocity", {"linear": 0.1, "angular": 1.0})
    log = run.finish()
    run.require_done()

    odometry = messages(log.path, "/base/odometry")
    assert len(odometry) == pytest.approx(8.0 * 50, abs=3)
    assert odometry[0].header.frame_id == "odom"
    places = np.array([(m.pose.pose.position.x, m.pose.pose.position.y) for m in odometry])
    # a circle with a radius of 0.1 m on the left, but for the ramp at the beginning and the end
    distance = np.hypot(places[50:-80, 0], places[50:-80, 1] - 0.1)
    assert distance == pytest.approx(0.1, abs=0.01)
    last = odometry[-1]
    assert last.twist.twist.linear.x == pytest.approx(0.0, abs=0.001)  # it has timed out
    row = log.cycles["position"]
    left, right = (row[-1] - row[0]) * 0.033
    heading = 2 * math.atan2(last.pose.pose.orientation.z, last.pose.pose.orientation.w)
    assert math.remainder(heading - (right - left) / 0.16, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert abs((right - left) / 0.16) > 5.5  # about a turn
