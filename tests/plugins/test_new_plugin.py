"""`dxlrun new-plugin` and `dxlrun plugins`: what is made, what is refused, and what is shown."""

from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.packages import installing

from dxlrun.cli.plugins import _NOT_COPIED

TEMPLATE = Path(__file__).parents[2] / "plugins" / "example"
PLUGIN = """
from dxlrun import Controller, Interfaces, hookimpl

class Mine(Controller):
    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints, ("position",), reference=("position",))
    def update(self, time_ns, period_ns):
        pass

@hookimpl
def dxlrun_contract():
    return CONTRACT

@hookimpl
def dxlrun_controllers():
    return {"mine": Mine}

@hookimpl
def dxlrun_overrun(cycle):
    return None
"""


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    """Work in an empty directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture
def install(tmp_path, monkeypatch):
    with installing(tmp_path, monkeypatch) as install:
        yield install


def test_the_package_has_names_of_its_own_and_no_licence(dxlrun, tmp_path):
    code, out, err = dxlrun("new-plugin", "arm-waves")
    assert (code, err) == (0, "")
    made = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert made == set(out.split("\n")[:-2])
    assert {"arm-waves/src/arm_waves/plugin.py", "arm-waves/tests/test_arm_waves.py"} <= made
    assert not any("LICENSE" in name for name in made)
    ours = [path for path in TEMPLATE.rglob("*") if path.is_file() and not set(path.parts) & set(_NOT_COPIED)]
    assert len(made) == len(ours) - 1 == 9
    assert out.endswith("next: cd arm-waves && pip install -e '.[test]' && python -m pytest\n")
    for name in made:
        text = (tmp_path / name).read_text()
        assert "dxlrun_easing" not in text + name
        assert "dxlrun-easing" not in text
        assert "icence" not in text
        assert "license" not in text
        assert "authors" not in text
    plugin = (tmp_path / "arm-waves/src/arm_waves/plugin.py").read_text()
    assert '{"arm_waves_controller": Easing}' in plugin
    code, out, _ = dxlrun("new-plugin", "arm_waves", "here/there", "--json")
    assert (code, result_of(out)["directory"], len(result_of(out)["files"])) == (0, "here/there", 9)
    assert len([path for path in (tmp_path / "here/there").rglob("*") if path.is_file()]) == 9


def test_a_broken_link_is_not_written_over(dxlrun, tmp_path):
    """Other refusals are in tests/cli/refusals.txt."""
    (tmp_path / "dangling").symlink_to("nowhere")
    code, _, err = dxlrun("new-plugin", "arms", "dangling")
    assert (code, err.count("\n"), "dangling cannot be written (it " in err) == (2, 1, True)
    assert not (tmp_path / "nowhere").exists()


def test_plugins_are_listed_with_what_they_offer(dxlrun, install):
    install("first-one", "first_one", PLUGIN.replace("CONTRACT", "1"))
    install("broken-one", "broken_one", PLUGIN.replace("CONTRACT", "5"))
    code, out, err = dxlrun("plugins")
    assert (code, err) == (0, "")
    lines = [line.split() for line in out.splitlines()]
    assert ["first_one_entry", "(first-one", "2.5,", "contract", "1)"] in lines
    assert ["mine", "position"] in lines
    assert ["decisions", "about", "late", "cycles"] in lines
    assert ["joint_trajectory_controller", "chunk", "trajectory"] in [line[:3] for line in lines]
    assert (
        "broken: plug-in broken_one_entry of broken-one 2.5 was written for contract 5, "
        "but this dxlrun has contract 4; install a matching version"
    ) in out


def test_the_list_for_programs(dxlrun, install):
    install("first-one", "first_one", PLUGIN.replace("CONTRACT", "2"))
    install("broken-one", "broken_one", "import no_such_thing")
    code, out, _ = dxlrun("plugins", "--json")
    found = {one["name"]: one for one in result_of(out)}
    assert code == 0
    first = found["first_one_entry"]
    assert (first["distribution"], first["contract"], first["broken"]) == ("first-one 2.5", 2, "")
    (mine,) = first["controllers"]
    assert (mine["type"], mine["references"], mine["commands"]) == ("mine", ["position"], [])
    assert first["overrun"]
    assert "No module named 'no_such_thing'" in found["broken_one_entry"]["broken"]
    sensors = {one["type"]: one["simulated"] for one in found["standard_controllers"]["sensors"]}
    assert sensors == {"serial_imu": False, "simulated_imu": True}
    standard = {one["type"]: one for one in found["standard_controllers"]["controllers"]}
    assert standard["joint_trajectory_controller"]["goals"] == ["trajectory"]
    assert standard["joint_state_broadcaster"]["topics"] == ["/joint_states"]
    assert standard["diff_drive_controller"]["live"]
