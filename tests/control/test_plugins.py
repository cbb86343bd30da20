"""Plug-ins are found one by one; a broken one is named, and never takes the others along."""

import sys

import pytest
from tests.kit.packages import installing

from dxlrun.control.controllers.plugin_loading import load_plugins

GOOD = """
from dxlrun import Controller, Interfaces, hookimpl

class Mine(Controller):
    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints)
    def update(self, time_ns, period_ns):
        pass

@hookimpl
def dxlrun_contract():
    return 1

@hookimpl
def dxlrun_controllers():
    return {"TYPE": Mine}
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    with installing(tmp_path, monkeypatch) as install:
        yield install


STANDARD = {"joint_state_broadcaster", "joint_trajectory_controller"}


def test_the_standard_controllers_enter_by_the_same_door():
    found = load_plugins()
    assert set(found.controllers) >= STANDARD
    assert found.controllers["joint_state_broadcaster"].distribution.startswith("dxlrun ")


def test_a_broken_plugin_is_named_and_the_others_are_offered_with_their_publishers(install):
    """Other mistakes are in tests/plugins/plain/mistakes.txt."""
    install("broken-one", "broken_plugin", GOOD.replace("return 1", "return 0"))
    install("my-robotics", "my_plugin", GOOD.replace("TYPE", "my_type"))
    found = load_plugins()
    assert set(found.broken) == {"broken_plugin_entry"}
    told = found.broken["broken_plugin_entry"]
    assert "plug-in broken_plugin_entry of broken-one 2.5" in told
    assert "was written for contract 0, but this dxlrun has contract 4" in told
    assert set(found.controllers) >= {"my_type", *STANDARD}
    offer = found.controllers["my_type"]
    assert (offer.type, offer.controller.__name__, offer.distribution) == (
        "my_type",
        "Mine",
        "my-robotics 2.5",
    )


def test_a_type_that_two_plugins_offer_is_nobodys(install):
    install("my-robotics", "my_plugin", GOOD.replace("TYPE", "joint_state_broadcaster"))
    found = load_plugins()
    assert set(found.controllers) >= STANDARD - {"joint_state_broadcaster"}
    assert "joint_state_broadcaster" not in found.controllers
    told = found.broken["joint_state_broadcaster"]
    assert "dxlrun 0" in told
    assert "my-robotics 2.5" in told


def test_after_each_load_a_hook_is_called_before_the_next_one(install):
    install("a-first", "first_plugin", "import second_plugin_was_not_there")
    install("b-second", "second_plugin", GOOD)
    told = []

    def after_each(name):
        told.append((name, "second_plugin" in sys.modules))

    load_plugins(after_each)
    assert told[:2] == [
        ("first_plugin_entry (a-first 2.5)", False),
        ("second_plugin_entry (b-second 2.5)", True),
    ]


def test_what_the_check_after_a_load_raises_passes_through():
    def refuse(name):
        raise RuntimeError(name)

    with pytest.raises(RuntimeError, match=r"analysis \(dxlrun"):
        load_plugins(refuse)


def test_all_classes_are_imported_before_the_loop_and_checked_each(install, tmp_path):
    (tmp_path / "late_law.py").write_text(GOOD)
    places = '"TYPE": "late_law:Mine", "gone": "nowhere:Mine"'
    install("my-robotics", "my_plugin", GOOD.replace('"TYPE": Mine', places))
    told = []
    found = load_plugins(told.append)
    assert "late_law" not in sys.modules
    found.import_all()
    assert "late_law" in sys.modules
    assert "TYPE" in told
    assert "gone" in found.broken


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("nowhere:Mine", "but nowhere:Mine cannot be imported (ModuleNotFoundError"),
        ("my_law:Other", "but my_law:Other cannot be imported (AttributeError"),
        ("my_law:Wrong", "offers Wrong as my_type: it is not a controller"),
    ],
)
def test_a_class_that_is_named_by_its_place_is_imported_when_it_is_used(install, tmp_path, place, says):
    (tmp_path / "my_law.py").write_text(GOOD + "\nclass Wrong: ...\n")
    install(
        "my-robotics",
        "my_plugin",
        GOOD.replace('"TYPE": Mine', f'"my_type": "{place}", "good": "my_law:Mine"'),
    )
    found = load_plugins()
    assert found.broken == {}
    assert {"my_type", "good"} <= set(found.controllers)
    assert found.controllers["good"].controller.__name__ == "Mine"
    assert found.controllers.get("my_type") is None
    assert says in found.broken["my_type"]
    assert "my_type" not in found.controllers
