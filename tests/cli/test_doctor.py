"""`dxlrun doctor` on made-up machines, the cases of doctor.txt, and on this one."""

import gzip
import json
import os
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import read_answer
from tests.kit.commands import Case, Dxlrun, cases, matches

from dxlrun.channels import c_sources
from dxlrun.control.realtime_grants import UNLIMITED
from dxlrun.run.machine_checks import RATES, Machine, diagnose, may_schedule, set_rates
from dxlwire.port.adapters import serial_devices, warnings_for

USB = "sys/devices/pci0/usb1/1-2"
GOOD = {
    "proc/sys/kernel/osrelease": "6.12.1-rt5",
    "proc/sys/kernel/version": "#1 SMP PREEMPT_RT Sat Nov 1 2025",
    "proc/sys/kernel/sched_rt_runtime_us": "950000",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
    "sys/devices/system/cpu/isolated": "3",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "performance",
    "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1",
    "dev/cpu_dma_latency": "",
    "dev/ttyUSB0": "",
    "etc/os-release": 'NAME="Some Linux"\nID=some\n',
}
ADAPTER = {f"{USB}/idVendor": "0403", f"{USB}/power/control": "on", f"{USB}/1-2:1.0/ttyUSB0/port_number": "0"}
DYNAMIC = {
    "proc/sys/kernel/osrelease": "6.18.4",
    "proc/sys/kernel/version": "#1 SMP PREEMPT_DYNAMIC Sat",
}
DISTURBERS = ("ModemManager", "brltty", "autosuspend")


class Made:
    """A machine that is good but for what is given."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.closed: set[str] = set()
        self.group = "dialout"
        self.properties: dict[str, Any] = {"platform": "linux", "user": "anna", "cores": 4, "root": root}
        self.properties |= {"highest_priority": 99, "lockable": UNLIMITED, "may_schedule": lambda: True}
        self.properties |= {"may_write": lambda path: path.name not in self.closed}
        self.write(GOOD)

    def write(self, files: dict[str, str]) -> None:
        for name, text in files.items():
            path = self.root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    def give(self, line: str) -> None:
        """Change the machine as a line of the text has it."""
        word, _, rest = line.partition(" ")
        if rest.startswith("= "):
            self._set(word, json.loads(rest.removeprefix("= ")))
        elif word == "no":
            (self.root / rest).unlink()
        elif word == "closed":
            self.closed |= set(rest.split())
        elif word == "group":
            self.group, _, mode = rest.partition(" ")
            (self.root / "dev/ttyUSB0").chmod(int(mode, 8))
            self.closed.add("ttyUSB0")
        elif word == "adapter":  # the port hangs on a USB device, as sysfs shows it
            self.write(ADAPTER)
            (self.root / "sys/class/tty/ttyUSB0").mkdir(parents=True)
            (self.root / "sys/class/tty/ttyUSB0/device").symlink_to(self.root / USB / "1-2:1.0/ttyUSB0")
        elif word == "dynamic":
            self.write(DYNAMIC)
        else:
            name, _, text = line.partition(":")
            self.write({name: text.strip().replace("\\n", "\n").replace("\\0", "\0")})

    def _set(self, name: str, value: Any) -> None:
        if name == "rates":
            self.properties["set_rates"] = lambda _: {int(asked): got for asked, got in value.items()}
        else:
            self.properties[name] = (lambda: value) if name == "may_schedule" else value

    @property
    def machine(self) -> Machine:
        return Machine(**self.properties)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Made:
    made = Made(tmp_path)
    monkeypatch.setattr(Path, "group", lambda _: made.group)
    monkeypatch.setattr(Machine, "this", lambda: made.machine)
    return made


@pytest.mark.parametrize("case", cases("doctor.txt"))
def test_what_could_be_better_is_listed_with_the_command_that_fixes_it(made: Made, case: Case) -> None:
    for _, line in case.lines:
        if not line.startswith("  "):
            made.give(line)
    expected = [line.strip() for _, line in case.lines if line.startswith("  ")]
    found = {one.what: one for one in diagnose(made.machine)}
    shown = [
        f"{one.what} {one.state}: {'; '.join(filter(None, (one.found, one.fix)))}"
        for one in found.values()
        if one.state != "good" or one.what == "preemption"
    ] or ["nothing"]
    assert len(shown) == len(expected), shown
    assert all(map(matches, expected, shown)), shown
    assert all(one.why and one.fix for one in found.values() if one.state != "good")
    warned = [*warnings_for("/dev/ttyUSB0", made.root)]  # by tools that open the port
    assert [one.partition(" ")[0].strip(":") for one in warned] == [
        one.partition(" ")[0] for one in shown if one.startswith(DISTURBERS)
    ]
    assert all(found[one.partition(": ")[0]].fix in one for one in warned)
    assert not [*warnings_for("/dev/pts/7", made.root)]
    ports = [path for path in serial_devices(made.root) if path not in found]
    assert not ports or "system" in shown[0]


def test_good_machine_has_nothing_to_fix(dxlrun: Dxlrun, made: Made) -> None:
    table = [line.split("  ") for line in dxlrun("doctor").out.splitlines()[:-1]]
    found = {row[0]: [cell.strip() for cell in row[1:] if cell] for row in table}
    assert [*found] == [
        *("system", "exchange", "/dev/ttyUSB0", "latency timer of ttyUSB0", "real-time priority"),
        *("locked memory", "kernel", "real-time share", "clock", "cores", "CPU governor", "idle latency"),
    ]
    assert {state for state, _ in found.values()} == {"good"}
    assert "isolated: 3" in found["cores"][1]  # for the loop
    rights = "up to 99, by the limit rtprio", "all memory, by the limit memlock"
    assert (found["real-time priority"][1], found["locked memory"][1]) == rights
    made.properties["capabilities"] = ("CAP_SYS_NICE", "CAP_IPC_LOCK")
    out = dxlrun("doctor").out
    assert "up to 99, by CAP_SYS_NICE" in out
    assert "all memory, by CAP_IPC_LOCK" in out
    assert out.splitlines()[-1] == "robots run here: 0 missing, 0 could be better"


def test_terminal_gets_a_table_the_commands_and_a_verdict(dxlrun: Dxlrun, made: Made) -> None:
    made.give("lockable = 8388608")
    said = dxlrun("doctor")
    lines = said.out.splitlines()
    assert (said.code, lines[0].split()) == (0, ["system", "good", "Linux", "6.12.1-rt5"])
    why = lines.index("locked memory: a page that was swapped out delays the loop by milliseconds")
    assert lines[why + 1].startswith("    echo 'anna - memlock unlimited' | sudo tee -a ")
    assert lines[-1] == "robots run here: 0 missing, 1 could be better"
    made.give('platform = "darwin"')
    said = dxlrun("doctor")
    assert said.code == 1
    assert said.out.splitlines()[-1] == "robots cannot run here yet: 1 missing, 0 could be better"


def test_configuration_of_the_running_kernel_may_be_compressed(made: Made) -> None:
    made.write(DYNAMIC)
    packed = made.root / "proc/config.gz"
    for content, named in (
        (gzip.compress(b"CONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n"), 1),
        (b"\x1f\x8b", 0),
    ):
        packed.write_bytes(content)
        assert [one.what for one in diagnose(made.machine)].count("preemption") == named


def test_what_a_machine_hides_is_not_called_bad(tmp_path: Path) -> None:
    """An empty root, as in a container without /sys: nothing is raised, nothing is called missing."""
    machine = Made(tmp_path / "some").properties | {"root": tmp_path / "none"}
    assert [one.what for one in diagnose(Machine(**machine)) if one.state != "good"] == ["kernel"]


def test_rates_of_a_pseudo_terminal_are_as_asked() -> None:
    master, slave = os.openpty()
    assert set_rates(Path(os.ttyname(slave))) == {rate: rate for rate in RATES}
    os.close(master)
    os.close(slave)


def test_trying_a_policy_leaves_none_behind() -> None:
    before = os.sched_getscheduler(0)
    may_schedule()
    assert os.sched_getscheduler(0) == before


def test_doctor_looks_at_this_machine(dxlrun: Dxlrun) -> None:
    said = dxlrun("doctor", "--json")
    answer = read_answer(said.out)
    checks = answer.result["checks"]
    states = {check["state"] for check in checks}
    assert (said.code, answer.ok) == ((1, False) if "missing" in states else (0, True))
    assert states <= {"good", "worse", "missing"}
    assert all(set(check) == {"what", "state", "found", "why", "fix"} for check in checks)
    assert all(check["fix"] for check in checks if check["state"] != "good")


@pytest.mark.parametrize("what", ["kernel", "gate", "mechanics", "shared_memory"])
def test_each_compiled_part_is_looked_for(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [tmp_path / path.name if path.stem == what else path for path in c_sources.SOURCES]
    monkeypatch.setattr(c_sources, "SOURCES", sources)
    assert Machine.this().compiled == f"the compiled {what} is missing; install dxlrun again"
