"""Names of the product's code: no bare verb, and one name for one thing. Each exemption has its reason."""

import ast
from collections import defaultdict
from pathlib import Path

from bench.house import BARE_VERBS

ROOT = Path(__file__).parents[1]
CONTRACT = "public contract of controllers"
STEERING = "method of `RemoteRobot`, named like the command of the command line"
FEATURE = "fixed name of a feature's file"
BARE = {
    **dict.fromkeys(("prepare", "begin", "judge", "end"), CONTRACT),
    **dict.fromkeys(("get", "listen", "play", "resume", "unload", "wait"), STEERING),
    "read": "public contract of sensors, and of the servos of a script",
    "write": "file-like object, and the servos of a script",
    "tell": "file-like object",
    "accept": "overrides `socket.socket.accept`",
    "receive": "ASGI callable",
    "clear": "container",
}
DEFINITIONS = {
    "prepare": 10,
    "read": 7,
    "write": 5,
    **dict.fromkeys(("begin", "judge", "end", "get", "wait"), 2),
}
"""Definitions of bare verbs, 1 if not here. A new one needs the same reason, and is counted here."""
SHARED_METHODS = {
    **dict.fromkeys(("close", "fileno"), "protocol of Python"),
    **dict.fromkeys(("update", "interfaces", "on_activate", "on_configure", "on_command"), CONTRACT),
    **dict.fromkeys(("on_parameters", "on_goal", "on_cancel", "on_deactivate", "prepare"), CONTRACT),
    "read": "public contract of sensors, and of the servos of a script",
    "report": "protocol `ReportSink`",
    "mistakes": "hook of `ParametersModel`",
    "add_slice": "protocol `Collector` of the analysis",
    "perform_on": "members of the union `Action` of the view",
    "words": "requests to the loop, each as text for its event",
    "now_ns": "protocol `Clock`, and the time of a record",
}
SHARED_CLASSES = {
    "Switch": "advertised by the service for viewers, and in the description of the HTTP interface",
    "TorqueRequest": "advertised by the service for viewers, and in the description of the HTTP interface",
    "Bus": "face of dxlwire, and in the schema of robot files",
    "RobotModel": "contract of controllers, and in the schema of robot files",
    "Point": "message of ROS 2, and in the schema of motion files",
    "PositionsCommand": "title in the schema of a command",
}
SHARED_MODULES = {
    **dict.fromkeys(
        ("compile", "form", "plan", "runtime", "safe", "servo_key", "servos", "settings", "table"), FEATURE
    ),
    "texts": "one table of texts for each room",
    **dict.fromkeys(("plugin", "hatch_build", "__init__", "__main__"), "fixed name in a package"),
}


def places() -> dict[str, dict[str, list[str]]]:
    """Return the files in which each name is defined, by kind of name."""
    found: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for base in ("runtime", "plugins"):
        for path in sorted((ROOT / base).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if "/tests/" in name or "/build/" in name:
                continue
            found["module"][path.stem].append(name)
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name in BARE_VERBS:
                    found["bare verb"][node.name].append(f"{name}:{node.lineno}")
                elif isinstance(node, ast.ClassDef):
                    found["class"][node.name].append(f"{name}:{node.lineno}")
                    for method in {each.name for each in node.body if isinstance(each, ast.FunctionDef)}:
                        found["method"][method].append(f"{name}:{node.lineno}")
    return found


def test_functions_name_their_object_and_no_name_is_shared() -> None:
    found = places()
    for kind, most, exempt in (
        *(("bare verb", 0, BARE), ("method", 5, SHARED_METHODS)),
        *(("class", 1, SHARED_CLASSES), ("module", 1, SHARED_MODULES)),
    ):
        names = {name for name, at in found[kind].items() if len(at) > most and not name.startswith("__")}
        wrong = {name: found[kind][name] for name in sorted(names - exempt.keys())}
        if exempt is BARE:
            wrong |= {
                name: found[kind][name] for name in names if len(found[kind][name]) > DEFINITIONS.get(name, 1)
            }
        assert not wrong, f"{kind}: {wrong}"
        assert not (unused := exempt.keys() - names - {"__init__", "__main__"}), f"{kind}: exempt {unused}"
