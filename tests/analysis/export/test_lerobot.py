"""Data sets hold what a policy is trained on, as LeRobotDataset v3.0 is described and as lerobot reads it."""

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.analysis.export.conftest import NAN, ROBOTS, ROWS, Row, made
from tests.kit.answers import result_of
from tests.kit.campaigns import campaign

from dxlrun.testing import read_log, simulated_robot
from dxlrun_analysis.export.episodes import Choice
from dxlrun_analysis.export.lerobot import write_dataset

pytestmark = pytest.mark.long

LEROBOT = os.getenv("DXLRUN_LEROBOT_PYTHON", "")


def frames(root: Path) -> Any:
    return pq.read_table(root / "data/chunk-000/file-000.parquet")


def states(root: Path, name: str = "observation.state") -> np.ndarray[Any, Any]:
    return np.array(frames(root)[name].to_pylist())


def ramp(count: int) -> tuple[Row, ...]:
    """Return cycles in which both joints are at the cycle's number, with goals half a step ahead."""
    return tuple((n, (n, n), (n + 0.5, n + 0.5), (NAN, NAN)) for n in range(count))


@pytest.fixture(scope="module")
def koch(tmp_path_factory):
    """The log of a leader arm that moves, and of its follower."""
    path = tmp_path_factory.mktemp("koch") / "koch.mcap"
    arguments = {"leader_arm": "true", "leader_torque": "on"}
    play = [ROBOTS / "motions/koch_wave.yaml"]
    simulated_robot(ROBOTS / "koch.yaml", arguments=arguments, play=play, log=path).run()
    return path


def test_a_data_set_is_as_lerobot_describes_it(run, tmp_path, export):
    root = tmp_path / "set"
    assert export(run, root, "lerobot", "--fps", 50, "--task", "wave").code == 0

    log = read_log(run)
    info = json.loads((root / "meta/info.json").read_text())
    count = len(log.cycles)
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 50, count)
    assert (info["total_episodes"], info["total_tasks"], info["splits"]) == (1, 1, {"train": "0:1"})
    assert info["features"]["observation.state"] == {
        "dtype": "float32",
        "shape": [len(log.joints)],
        "names": [f"{joint}.pos" for joint in log.joints],
    }
    data = pq.read_table(root / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        stored = data.schema.field(name).type
        if feature["shape"] != [1]:
            assert stored.list_size == feature["shape"][0]
            stored = stored.value_type
        assert stored == pa.type_for_alias({"float32": "float", "int64": "int64"}[feature["dtype"]])
    columns = {
        "observation.state": "position",
        "action": "goal_position",
        "observation.environment_state": "effort",
    }
    for column, field in columns.items():
        np.testing.assert_array_equal(states(root, column), log.cycles[field].astype(np.float32))
    np.testing.assert_allclose(data["timestamp"].to_numpy(), np.arange(count) / 50, atol=1e-6)
    assert data["frame_index"].to_pylist() == data["index"].to_pylist() == list(range(count))
    (episode,) = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["episode_index"], episode["length"], episode["dataset_to_index"]) == (0, count, count)
    tasks = pq.read_table(root / "meta/tasks.parquet")
    assert tasks["task"].to_pylist() == episode["tasks"] == ["wave"]
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]
    statistics = json.loads((root / "meta/stats.json").read_text())
    assert statistics.keys() == info["features"].keys()
    positions = log.cycles["position"].astype(np.float32).astype(float)
    for key, expected in (("mean", positions.mean(axis=0)), ("std", positions.std(axis=0))):
        np.testing.assert_allclose(statistics["observation.state"][key], expected, rtol=1e-9)
        np.testing.assert_allclose(episode[f"stats/observation.state/{key}"], expected, rtol=1e-9)


def test_followers_observe_and_their_leaders_act(koch, tmp_path, export):
    root, log = tmp_path / "set", read_log(koch)
    assert export(koch, root, "lerobot", "--fps", 100).code == 0
    features = json.loads((root / "meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == [f"{joint}.pos" for joint in log.joints[6:]]
    assert features["action"]["names"] == features["observation.state"]["names"]
    leaders, followers = np.hsplit(log.cycles["position"].astype(np.float32), 2)
    np.testing.assert_array_equal(states(root), followers)
    np.testing.assert_array_equal(states(root, "action"), leaders)

    options = ("--observation", "wrist_roll", "leader_roll", "--action", "leader_joints")
    assert export(koch, tmp_path / "own", "lerobot", "--fps", 100, *options).code == 0
    positions, goals = log.cycles["position"], log.cycles["goal_position"]
    np.testing.assert_array_equal(states(tmp_path / "own"), positions[:, [10, 4]].astype(np.float32))
    np.testing.assert_array_equal(states(tmp_path / "own", "action"), goals[:, :6].astype(np.float32))


@pytest.mark.parametrize(
    ("period_ns", "options", "cycles"),
    [
        (10_000_000, (), [0, 3, 6, 10, 13, 16, 20]),  # 100 Hz, and 30 frames per second
        (16_666_667, ("--fps", 60), list(range(22))),  # of 60 Hz, rounded up
        (16_000_000, ("--fps", 50), [0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 13, 15, 16, 17, 18, 20]),
        (80_000_000, (), list(range(21))),  # 12.5 Hz: 12 frames per second
    ],
)
def test_a_frame_has_the_newest_cycle_that_began_before_it(tmp_path, export, period_ns, options, cycles):
    """So nothing in an observation was measured after the action."""
    log = made(tmp_path / "a.mcap", ramp(22), period_ns=period_ns)
    assert export(log, tmp_path / "set", "lerobot", *options).code == 0
    assert states(tmp_path / "set")[:, 0].tolist() == cycles
    np.testing.assert_allclose(states(tmp_path / "set", "action") - states(tmp_path / "set"), 0.5)


def test_frames_begin_with_the_first_goal_and_skipped_periods_repeat(tmp_path, export):
    log = made(tmp_path / "a.mcap", skipped={4: 2})
    said = export(log, tmp_path / "set", "lerobot", "--fps", 50, "--json")
    observed = np.array([[0.1, 1.0]] * 3 + [[0.2, 1.1], [0.3, 1.2]])
    np.testing.assert_allclose(states(tmp_path / "set"), observed, rtol=1e-6)
    goals = np.array([[2.0, 0.5]] * 3 + [[3.0, 0.6]] * 2)
    np.testing.assert_allclose(states(tmp_path / "set", "action"), goals, rtol=1e-6)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["action"]["names"] == ["wheel.vel", "arm.pos"]
    assert {key: result_of(said.out)[key] for key in ("frames", "fps", "episodes", "held")} == {
        "frames": 5,
        "fps": 50,
        "episodes": [1],
        "held": 2,
    }


def test_cycles_that_are_missing_end_an_episode(tmp_path, export):
    """No frames are made up for them."""
    assert export(made(tmp_path / "a.mcap"), tmp_path / "set", "lerobot", "--fps", 50).code == 0
    data = frames(tmp_path / "set")
    np.testing.assert_allclose(states(tmp_path / "set"), [[0.1, 1.0], [0.2, 1.1], [0.3, 1.2]], rtol=1e-6)
    assert data["episode_index"].to_pylist() == [0, 1, 1]
    assert data["frame_index"].to_pylist() == [0, 0, 1]
    assert data["index"].to_pylist() == [0, 1, 2]
    np.testing.assert_allclose(data["timestamp"].to_numpy(), [0, 0, 0.02], rtol=1e-6)
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    keys = ("length", "dataset_from_index", "dataset_to_index")
    assert [tuple(one[key] for key in keys) for one in episodes] == [(1, 0, 1), (2, 1, 3)]
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["splits"] == {"train": "0:2"}
    np.testing.assert_allclose(episodes[1]["stats/observation.state/mean"], [0.25, 1.15], rtol=1e-6)


def test_a_lost_reply_is_held_and_a_silent_joint_ends_the_episode(tmp_path, export):
    silent = {3: 1, **{number: number - 9 for number in range(10, 20)}}
    log = made(tmp_path / "a.mcap", ramp(24), silent=silent)
    said = export(log, tmp_path / "set", "lerobot", "--fps", 50)
    data = frames(tmp_path / "set")
    held = [*range(15), *range(20, 24)]  # 10 to 14: at most 100 ms
    assert states(tmp_path / "set")[:, 0].tolist() == held
    assert data["episode_index"].to_pylist() == [0] * 15 + [1] * 4
    assert "6 frames have a state from an earlier cycle" in said.out
    assert f"{log}: 2 episodes, because cycles or replies are missing for a time" in said.out


def test_a_pause_ends_the_episode(tmp_path, export):
    rows = [*ramp(6), *((n, (n, n), (n, n), (NAN, NAN)) for n in range(14, 18))]
    log = made(tmp_path / "a.mcap", rows, skipped={14: 8})
    assert export(log, tmp_path / "set", "lerobot", "--fps", 50).code == 0
    assert frames(tmp_path / "set")["episode_index"].to_pylist() == [0] * 6 + [1] * 4


def test_each_log_is_an_episode(koch, tmp_path, export):
    logs = [made(tmp_path / name, ramp(count)) for name, count in (("a.mcap", 5), ("b.mcap", 7))]
    assert export(logs[0], logs[1], tmp_path / "set", "lerobot", "--fps", 50).code == 0
    assert states(tmp_path / "set")[:, 0].tolist() == [*range(5), *range(7)]
    assert frames(tmp_path / "set")["episode_index"].to_pylist() == [0] * 5 + [1] * 7

    cut = tmp_path / "cut.mcap"
    cut.write_bytes(koch.read_bytes()[:-40_000])
    said = export(koch, cut, tmp_path / "arms", "lerobot")
    assert (said.code, len(said.errors)) == (0, 1)
    assert f"{cut}: the file ends early" in said.errors[0]
    assert 240 < len(frames(tmp_path / "arms")) < 480


def test_actions_are_those_of_the_joints_that_have_goals(tmp_path, export):
    rows = tuple((number, (0.1, 1.0), (NAN, 0.5), (NAN, NAN)) for number in range(2))
    assert export(made(tmp_path / "a.mcap", rows), tmp_path / "set", "lerobot", "--fps", 50).code == 0
    assert frames(tmp_path / "set")["action"].to_pylist() == [0.5, 0.5]


def test_a_data_set_is_the_same_however_the_log_is_sliced(tmp_path):
    rows = (*ROWS, (6, (0.4, 1.3), (NAN, NAN), (1.0, NAN)))
    log = read_log(made(tmp_path / "a.mcap", rows, {4: 2}))
    sizes = (1, 2, 3, 9)
    for size in sizes:
        parts = [replace(log, cycles=log.cycles[at : at + size]) for at in range(0, len(log.cycles), size)]
        reader: Any = SimpleNamespace(
            path=log.path, about=log, slices=lambda packets, parts=parts: iter(parts)
        )
        assert write_dataset([reader], tmp_path / str(size), Choice(fps=40)).frames == 5
    tables = [frames(tmp_path / str(size)) for size in sizes]
    assert all(table.equals(tables[0]) for table in tables)
    figures = [json.loads((tmp_path / str(size) / "meta/stats.json").read_text()) for size in (1, 9)]
    assert len(figures[0]) > 5
    for name, one in figures[0].items():
        for key, values in one.items():
            np.testing.assert_allclose(values, figures[1][name][key], rtol=1e-9, atol=1e-12)


# lerobot itself


@campaign(ci=0, night=0, release=1)
@pytest.mark.skipif(not LEROBOT, reason="DXLRUN_LEROBOT_PYTHON names no Python with lerobot")
def test_lerobot_loads_a_data_set_and_trains_act_on_it(koch, tmp_path, export, number):
    second = tmp_path / "second.mcap"
    second.write_bytes(koch.read_bytes())
    assert export(koch, second, tmp_path / "set", "lerobot", "--task", "pick the cube").code == 0
    small = ("dim_model=64", "n_heads=2", "dim_feedforward=64", "chunk_size=10", "n_action_steps=10")
    command = [LEROBOT, "-m", "lerobot.scripts.lerobot_train", "--steps=10", "--batch_size=8", "--log_freq=1"]
    command += [f"--dataset.root={tmp_path / 'set'}", "--dataset.repo_id=local/set", "--num_workers=0"]
    command += ["--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false"]
    command += [*(f"--policy.{one}" for one in small), f"--output_dir={tmp_path / 'trained'}"]
    command += ["--save_checkpoint=false", "--eval_freq=0"]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr[-4000:]
    steps = [line for line in said.stderr.splitlines() if " step:" in line and " loss:" in line]
    assert len(steps) == 10, said.stderr[-4000:]
    assert "dataset.num_episodes=2" in said.stderr
