"""Start-up: which modules a command imports; how long that takes is measured by bench/startup.py."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import dxlrun

ROOT = Path(__file__).parents[2]
COMMANDS = """
import contextlib, dataclasses, io, json, sys
made, found = [], []
process = dataclasses._process_class
dataclasses._process_class = lambda cls, *rest: made.append(cls) or process(cls, *rest)
from dxlrun.cli import main
for line in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        main(line.split())
    found.append(sorted(sys.modules))
print(json.dumps([found, [cls.__name__ for cls in made if cls.__module__.startswith("dxl")]]))
"""
VALIDATORS = """
import json
import dxlrun.features.devices.form, dxlrun.features.mechanics.form, dxlrun.features.recording.form
import dxlrun.description.robot
from dxlrun.description.base_form import Form
def forms(form):
    return [form, *(each for below in form.__subclasses__() for each in forms(below))]
built = [each.__name__ for each in forms(Form) if each.__pydantic_complete__]
texts = [each.__name__ for each in forms(Form) if str in map(type, each.__annotations__.values())]
print(json.dumps([len(forms(Form)), built, texts]))
"""
THREADS = """
import contextlib, io, json, os, sys
from dxlrun.cli import main
sys.argv = ["dxlrun", "--version"]
with contextlib.redirect_stdout(io.StringIO()):
    main()
import numpy
print(json.dumps(os.listdir("/proc/self/task")))
"""
LOOP = """
import json, sys
import dxlrun.run.loop_process
from dxlrun.control.monitors.monitor_stage import MonitorStage
from dxlrun.features import FEATURES, stages
assert list(stages(MonitorStage, FEATURES))
print(json.dumps(sorted(sys.modules)))
"""
RUN_TIME = {
    "dxlrun.control": ("gate", "loop", "realtime_grants", "safe_motion", "steering"),
    "dxlrun.dynamixel": ("dynamixel_hardware", "servo/life", "servo/servo_supervision", "tools"),
    "dxlrun.log": ("identity", "recorder", "log_writer", "log_reader"),
    "dxlsim": ("bus", "serving"),
    "dxlwire": ("exchange", "port"),
}
"""Rooms of which `check` needs the plans, and the parts that it does not."""
CHECK_HELP = {
    *("dxlrun.cli", "dxlrun.cli.app", "dxlrun.cli.inputs", "dxlrun.cli.run", "dxlrun.cli.check"),
    *("dxlrun.cli.verb_registry", "dxlrun.installed_plugins"),
    *("dxlrun.cli.tools", "dxlrun.cli.tools.tool_log"),
    *("dxlrun.output", "dxlrun.output.json", "dxlrun.output.text_table", "dxlrun.output.terminal"),
    *("dxlrun.output.escaping", "dxlrun.output.target", "dxlrun.output.unblocked", "dxlrun.errors"),
}
"""Modules that the help of `check` needs."""


def printed(code: str, *words: str) -> list:
    """Return the list that a process prints as JSON."""
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    found: list = json.loads(done.stdout)
    return found


def after(*lines: str) -> tuple[list[set[str]], set[str]]:
    """Return the modules of a process after each command, and our dataclasses that it made."""
    found, made = printed(COMMANDS, json.dumps(lines))
    return [set(modules) for modules in found], set(made)


def beneath(modules: set[str], *packages: str) -> set[str]:
    return {name for name in modules if any(f"{name}.".startswith(f"{each}.") for each in packages)}


def test_a_command_line_takes_interrupts_after_few_imports() -> None:
    before, after = (
        {*printed(f"import json, sys{more}; print(json.dumps([*sys.modules]))")}
        for more in ("", ", dxlrun.cli")
    )
    assert after - before <= {"__future__", "gc", "dxlrun", "dxlrun.cli", "dxlwire", "dxlwire.faces"}


def test_what_needs_no_robot_imports_neither_numpy_nor_pydantic() -> None:
    (version, general), _ = after("--version", "--help")
    (check, pause, unknown), _ = after("check --help", "pause --help", "no_such_verb")
    assert "cyclopts" not in version | general
    assert "cyclopts" in check
    heavy = {"numpy", "pydantic", "yaml", "mcap", "serial", "msgspec", "markdown_it"}
    assert heavy & (general | pause | unknown) == set()
    assert {name for name in check if name.startswith("dxlrun.")} == CHECK_HELP
    assert check & {"rich.markdown", "cyclopts.completion"} == set()


@pytest.fixture(scope="module")
def checked() -> tuple[set[str], set[str]]:
    (modules,), made = after("check robots/bioloid_torso.yaml")
    return modules, made


def test_check_imports_no_part_that_runs(checked: tuple[set[str], set[str]]) -> None:
    modules, _ = checked
    run_time = (f"{room}.{part.replace('/', '.')}" for room, parts in RUN_TIME.items() for part in parts)
    assert beneath(modules, *run_time, "dxlrun.remote", "dxlrun.run") == set()
    packages = beneath(modules, "dxlrun_analysis", "dxlrun_lab", "dxlrun_mujoco")
    assert packages <= {f"dxlrun_{one}{part}" for one in ("analysis", "lab") for part in ("", ".plugin")}
    unused = "mujoco mcap starlette uvicorn lz4 zstandard serial matplotlib simpleeval rich subprocess"
    assert beneath(modules, *unused.split()) == set()
    # ROS 2 messages and goals in space are for controllers that use them.
    assert beneath(modules, "dxlrun.messages", "dxlrun_space.space_goals") == set()
    # the names above are those of modules that exist
    assert modules >= {"dxlrun.compile.robot_compiler", "dxlrun.description.robot", "pydantic", "yaml"}
    for room, parts in RUN_TIME.items():
        folder = ROOT / "runtime" / room.replace(".", "/")
        assert {part for part in parts if not any(folder.glob(f"{part}*"))} == set()


def test_check_generates_no_methods_of_records(checked: tuple[set[str], set[str]]) -> None:
    """A dataclass takes 50 times as long to import as a struct, and longer than a named tuple."""
    # The first two have fields without arguments, and `RobotInfo` inherits from the third and another one.
    assert checked[1] == {"States", "Commands", "JointValues"}


def test_forms_build_no_validators_and_compile_no_annotations_on_import() -> None:
    """The form of the robot file builds one validator for all sections."""
    forms, built, texts = printed(VALIDATORS)
    assert forms > 30
    assert built == texts == []


def test_virtual_run_imports_neither_gateway_nor_physics() -> None:
    (ran,), _ = after("robots/bioloid_torso.yaml --virtual --duration 0.1 --no-record")
    assert "dxlsim.serving.simulation_server" not in ran
    assert beneath(ran, "mujoco", "starlette", "uvicorn", "matplotlib", "rich", "dxlrun.remote") == set()
    assert "dxlrun.run.virtual_run" in ran


def test_monitors_bring_no_compiler_into_the_process_of_the_loop() -> None:
    """A policy of one module has its monitor next to what `check` needs of it."""
    imported = set(printed(LOOP))
    assert beneath(imported, "dxlrun.compile") == {"dxlrun.compile", "dxlrun.compile.contribution"}
    assert beneath(imported, "yaml", "rich", "cyclopts", "dxlrun.cli", "dxlrun.remote.gateway") == set()


def test_commands_start_no_thread_for_each_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is one core, numpy starts none."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert len(printed(THREADS)) == 1


def test_guardian_needs_neither_numpy_nor_pydantic() -> None:
    """Each run waits until it is there."""
    imported = set(printed("import json, sys, dxlrun.run.guardian; print(json.dumps([*sys.modules]))"))
    assert "dxlrun.run.guardian" in imported
    assert beneath(imported, "numpy", "pydantic", "yaml", "rich", "cyclopts", "importlib.metadata") == set()


def test_a_run_is_begun_without_what_its_other_processes_do() -> None:
    imported = set(printed("import json, sys, dxlrun.run.supervisor; print(json.dumps([*sys.modules]))"))
    assert beneath(imported, "dxlrun.run.guardian") != set()
    assert beneath(imported, "dxlrun.run.loop_process", "mcap.writer") == set()


def test_every_name_is_there():
    assert len(dxlrun.__all__) > 30
    for name in dxlrun.__all__:
        assert getattr(dxlrun, name) is not None
    assert set(dxlrun.__all__) <= set(dir(dxlrun))


@pytest.mark.parametrize("module", ["dxlrun", "dxlrun.control.realtime_grants"])
def test_importing_it_loads_neither_numpy_nor_pydantic(module: str) -> None:
    imported = set(printed(f"import json, sys, {module}; print(json.dumps([*sys.modules]))"))
    assert beneath(imported, "numpy", "pydantic", "pluggy") == set()
