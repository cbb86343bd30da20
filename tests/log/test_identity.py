"""Identity: a log names the files, the code, the git revision and the machine of its run."""

import platform
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.log import identity
from dxlrun.log.identity import IDENTITY_NAME, code_hashes, git_state, module_files, package_of
from dxlrun.testing import read_log, simulated_robot

ROBOTS = Path(__file__).parents[2] / "robots"


def hash_of(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def git(folder: Path, *arguments: str) -> str:
    """Run git as a person would."""
    names = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", *names, *arguments]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=DEADLINE_S)
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path):
    """A robot file in a repository, committed."""
    (tmp_path / "robot.yaml").write_text("name: a\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "robot.yaml")
    git(tmp_path, "commit", "-q", "-m", "first")
    return tmp_path


def test_a_log_has_the_hash_of_each_file_of_its_run(torso):
    robot, motion = ROBOTS / "bioloid_torso.yaml", ROBOTS / "motions/three_parts.yaml"
    read = read_log(torso / "whole.mcap")
    record = read.metadata[IDENTITY_NAME]
    group = Path(sys.modules["dxlrun_controllers.group"].__file__ or "")
    files = {
        "robot bioloid_torso.yaml": robot,
        "motion motions/three_parts.yaml": motion,
        "urdf": ROBOTS / "urdf/bioloid_torso.urdf",
        "plugin dxlrun dxlrun_controllers/group.py": group,
    }
    assert {key: record[key] for key in files} == {key: hash_of(path) for key, path in files.items()}
    assert read.attachments["motion/motions/three_parts.yaml"] == motion.read_bytes()
    packages = {package_of(key) for key in record if key.startswith("plugin ")}
    assert packages == {("dxlrun_controllers", "dxlrun")}
    assert len(record["runtime"]) == 64
    assert record["host"] == platform.node()
    assert platform.release() in record["kernel"]


def test_included_and_motor_files_are_named_as_seen_from_the_robot_file(tmp_path):
    (tmp_path / "robot").mkdir()
    part = tmp_path / "parts.yaml"
    part.write_text("loop: {rate: 50}\n")
    (tmp_path / "robot/r.yaml").write_text(
        "name: r\ninclude: [../parts.yaml]\nbuses: {main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}}\n"
        "joints:\n  a: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, "
        "limits: {position: [-90 deg, 90 deg]}}\n"
        "controllers: {b: {type: joint_state_broadcaster}}\n"
    )
    log = tmp_path / "run.mcap"
    simulated_robot(tmp_path / "robot/r.yaml", duration_s=0.1, log=log).run()
    record = read_log(log).metadata[IDENTITY_NAME]
    assert record["included ../parts.yaml"] == hash_of(part)
    assert "git revision" not in record


def test_git_says_which_revision_and_whether_a_file_it_has_was_changed(repository):
    revision = git(repository, "rev-parse", "HEAD")
    (repository / "logs").mkdir()
    (repository / "logs/run.mcap").write_text("a log next to the robot file is no change")
    assert git_state(repository, "robot.yaml") == {"git revision": revision, "git changed": "no"}
    (repository / "robot.yaml").write_text("name: b\n")
    assert git_state(repository, "robot.yaml") == {"git revision": revision, "git changed": "yes"}
    (repository / "other.yaml").write_text("name: c\n")
    assert git_state(repository, "other.yaml")["git changed"] == "yes"  # git does not have it


def test_a_hook_of_another_repository_does_not_lead_elsewhere(repository, tmp_path_factory, monkeypatch):
    other = tmp_path_factory.mktemp("other")
    git(other, "init", "-q")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    assert git_state(repository, "robot.yaml")["git changed"] == "no"


@pytest.mark.parametrize("how", ["missing", "slow", "broken", "no commit"])
def test_a_run_does_without_git(how, repository, tmp_path_factory, monkeypatch):
    commands = tmp_path_factory.mktemp("bin")
    if how == "no commit":
        git(repository, "update-ref", "-d", "HEAD")
    else:
        monkeypatch.setenv("PATH", str(commands))
    if how in ("slow", "broken"):
        program = commands / "git"
        program.write_text("#!/bin/sh\n" + ("exec /bin/sleep 60\n" if how == "slow" else "exit 128\n"))
        program.chmod(0o755)
        monkeypatch.setattr(identity, "_GIT_TIMEOUT_S", 0.1)
    assert git_state(repository, "robot.yaml") == {}


def test_another_byte_in_a_plug_in_is_another_hash(tmp_path, monkeypatch):
    package = tmp_path / "waves"
    (package / "__pycache__").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "wave.py").write_text("amplitude = 1\n")
    (package / "__pycache__/wave.cpython-311.pyc").write_bytes(b"not a source")
    monkeypatch.syspath_prepend(tmp_path)
    before = code_hashes([("waves", "wave-robots")])
    (package / "wave.py").write_text("amplitude = 2\n")
    after = code_hashes([("waves", "wave-robots")])
    key = "plugin wave-robots waves/wave.py"
    assert [name for name in after if before[name] != after[name]] == [key]
    assert set(before) == {key, "plugin wave-robots waves/__init__.py", "runtime"}
    assert package_of(key) == ("waves", "wave-robots")
    assert package_of("plugin wave-robots wave.py") == ("wave", "wave-robots")


def test_a_package_without_a_place_has_no_files(monkeypatch):
    monkeypatch.setitem(sys.modules, "from_memory", type(sys)("from_memory"))
    assert module_files("from_memory") == []
    assert module_files("not_installed_at_all") == []
