"""The measures of `house.py`, on sources that are made up."""

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
