"""The measures of `house.py`, on sources that are made up."""

from __future__ import annotations

import house


def test_a_name_from_a_face_is_not_from_inside() -> None:
    texts = {
        "runtime/dxlrun/log/__init__.py": "",
        "runtime/dxlrun/tooling/__init__.py": "",
        "runtime/dxlrun/tooling/html.py": "",
        "plugins/a/run.py": """
import dxlrun
from dxlrun import Log, log
from dxlrun.tooling import html
from dxlrun.tooling.html import section
def late():
    from dxlrun.log.log_reader import LogReader
    import dxlwire.wire.crc, numpy
from dxlwire import Bus
""",
    }
    inside = {name for _, name, of_face in house.imported_names(texts) if not of_face}
    faces = {name for _, name, of_face in house.imported_names(texts) if of_face}
    assert inside == {"dxlrun.log", "dxlrun.log.log_reader.LogReader", "dxlwire.wire.crc"}
    assert faces == {
        "dxlrun",
        "dxlrun.Log",
        "dxlrun.tooling.html",
        "dxlrun.tooling.html.section",
        "dxlwire.Bus",
    }


def test_a_word_is_mentioned_in_code_outside_its_folder_only() -> None:
    texts = {
        "runtime/dxlrun/features/devices/plan.py": "device_commands = 1",
        "runtime/dxlrun/said.py": '"""The device_command."""\n# device_command\nsay("no device_command")',
        "runtime/dxlrun/key.py": "a['device_command']",
        "runtime/dxlrun/name.py": "class DeviceCommand: ...",
        "runtime/dxlrun/gate.c": "/* device_command */ int a; // device_command",
        "runtime/dxlrun/kernel.c": "int device_command;",
    }
    codes = {path: house.code_of(path, text) for path, text in texts.items()}
    found = house.mentioning(codes, house.MENTIONS["device command"])
    assert [path.rpartition("/")[2] for path in found] == ["key.py", "name.py", "kernel.c"]


def test_a_twist_does_not_ask_whether_a_joint_is_linear() -> None:
    codes = {"twist.py": "a = twist.linear.x", "joint.py": "a = joint.linear", "plan.py": "plan(linear=True)"}
    codes |= {"unit.py": "a = joint.unit is not LINEAR", "table.py": "a = {ROTARY: 1.0, LINEAR: 0.1}"}
    assert house.mentioning(codes, house.LINEAR) == ["joint.py", "plan.py", "unit.py"]


def test_a_room_is_a_library_a_package_or_a_feature() -> None:
    rooms = {
        "runtime/dxlwire/wire/crc.py": "dxlwire",
        "runtime/dxlrun/log/reading/a.py": "dxlrun/log",
        "runtime/dxlrun/clock.py": "dxlrun/clock",
        "runtime/dxlrun/features/devices/form.py": "dxlrun/features/devices",
        "runtime/dxlrun/features/feature.py": "dxlrun/features/feature",
        "plugins/dxlrun_view/src/dxlrun_view/live_robot.py": "dxlrun_view",
    }
    assert {path: house.room_of(path) for path in rooms} == rooms


def test_only_public_functions_of_modules_and_classes_are_without_an_object() -> None:
    texts = {"a.py": "def take(): ...\nclass A:\n def look(self):\n  def end(): ...\n def _read(self): ..."}
    assert [name for _, name in house.bare_functions(texts)] == ["take", "look"]


def test_a_parameter_is_handed_on_if_each_use_is_an_argument() -> None:
    text = """
class A:
    def __init__(self, given, kept, asked, read):
        f(given, *given, by=given)
        self._kept, self._asked = None, asked
        self._kept = kept
        g(read.part)
    def go(self, unused):
        f(self._kept)
@dataclass
class B:
    _field: int
    public: int
    state: int = field(init=False)
    def go(self):
        f(self._field, self.public)
class C(Protocol):
    def go(self, x): ...
"""
    found = [(one.owner, one.is_built, one.handed_on) for one in house.parameters({"a.py": text})]
    assert sorted(found) == [
        ("A", True, False),
        ("A", True, False),
        ("A", True, True),
        ("A", True, True),
        ("B", True, False),
        ("B", True, True),
        ("go", False, False),
    ]
