"""`dxlrun doctor` on this machine, and on made-up ones that lack one thing each."""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import read_answer

from dxlrun.channels import c_sources
from dxlrun.control.realtime_grants import UNLIMITED
from dxlrun.run.machine_checks import RATES, CheckResult, Machine, diagnose, may_schedule, set_rates
from dxlwire.port.adapters import serial_devices, warnings_for

GOOD = {
    "proc/sys/kernel/osrelease": "6.12.1-rt5",
    "proc/sys/kernel/version": "#1 SMP PREEMPT_RT Sat Nov 1 2025",
    "proc/sys/kernel/sched_rt_runtime_us": "950000",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
    "sys/devices/system/cpu/isolated": "",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "performance",
    "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1",
    "dev/cpu_dma_latency": "",
    "dev/ttyUSB0": "",
    "etc/os-release": 'NAME="Some Linux"\nID=some\n',
}
Look = Callable[..., dict[str, CheckResult]]


@pytest.fixture
def look(tmp_path: Path) -> Look:
    """Return what the doctor finds on a machine that is good but for what is given, by what was looked at."""

    def look(files: dict[str, str | None] | None = None, **other: Any) -> dict[str, CheckResult]:
        for name, text in (GOOD | (files or {})).items():
            if text is not None:
                path = tmp_path / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        rights = {"user": "anna", "cores": 4, "highest_priority": 99, "lockable": UNLIMITED}
        given = rights | {"platform": "linux", "may_schedule": lambda: True, "may_write": lambda _: True}
        return {one.what: one for one in diagnose(Machine(**(given | {"root": tmp_path} | other)))}

    return look


USB = "sys/devices/pci0/usb1/1-2"
ADAPTER = {f"{USB}/idVendor": "0403", f"{USB}/power/control": "on", f"{USB}/1-2:1.0/ttyUSB0/port_number": "0"}
BRLTTY = "usr/lib/udev/rules.d/85-brltty.rules"
RULE = 'ENV{PRODUCT}=="1a86/7523/*", ENV{BRLTTY_BRAILLE_DRIVER}="bm", GOTO="brltty_usb_run"\n'


@pytest.fixture
def with_adapter(tmp_path: Path) -> None:
    """The port hangs on a USB device, as sysfs shows it."""
    (tmp_path / USB / "1-2:1.0/ttyUSB0").mkdir(parents=True)
    (tmp_path / "sys/class/tty/ttyUSB0").mkdir(parents=True)
    (tmp_path / "sys/class/tty/ttyUSB0/device").symlink_to(tmp_path / USB / "1-2:1.0/ttyUSB0")


@pytest.mark.usefixtures("with_adapter")
@pytest.mark.parametrize(
    ("files", "what", "fix"),
    [
        (
            {"proc/812/comm": "ModemManager\n"},
            "ModemManager",
            "sudo systemctl disable --now ModemManager",
        ),
        ({"proc/900/comm": "brltty\n"}, "brltty", "sudo apt remove brltty"),
        ({BRLTTY: f"# Braille\n{RULE}"}, "brltty", "sudo apt remove brltty"),
        (
            {f"{USB}/power/control": "auto\n"},
            "autosuspend of ttyUSB0",
            f"echo on | sudo tee /{USB}/power/control",
        ),
    ],
)
def test_what_disturbs_an_adapter_is_found(
    look: Look, tmp_path: Path, files: dict[str, str], what: str, fix: str
) -> None:
    one = look(ADAPTER | files)[what]
    assert one.state == "worse"
    assert one.fix.startswith(fix)
    (sentence,) = warnings_for("/dev/ttyUSB0", tmp_path)
    assert sentence.startswith(f"{what}: ")
    assert fix in sentence
    assert not [*warnings_for("/dev/pts/7", tmp_path)]


@pytest.mark.usefixtures("with_adapter")
@pytest.mark.parametrize(
    "files",
    [
        {"proc/812/comm": "ModemManagerX"},
        {BRLTTY: f"#{RULE}"},  # as newer systems have it
        {"proc/812/comm": "ModemManager", "dev/ttyUSB0": None},
        {f"{USB}/power/control": "auto", f"{USB}/idVendor": None},
    ],
)
def test_what_disturbs_no_adapter_is_not_named(
    look: Look, tmp_path: Path, files: dict[str, str | None]
) -> None:
    found = look(ADAPTER | files)
    assert not {"ModemManager", "brltty", "autosuspend of ttyUSB0"} & set(found)
    assert not [*warnings_for("/dev/ttyUSB0", tmp_path)]


def test_ports_of_the_board_are_listed_and_never_missing(look: Look, tmp_path: Path) -> None:
    ports = ("ttyUSB1", "ttyACM0", "ttyAMA0", "ttyTHS1", "ttySC0", "serial0")
    files = {f"dev/{name}": "" for name in ports}
    found = look(files, may_write=lambda path: path.name.startswith("ttyUSB"))
    assert found["/dev/ttyACM0"].state == "missing"
    for name in ports[2:]:
        assert found[f"/dev/{name}"].state == "worse"
        assert found[f"/dev/{name}"].fix
    assert serial_devices(tmp_path) == ("/dev/ttyUSB0", *(f"/dev/{name}" for name in ports))


def test_rates_that_a_driver_does_not_have_are_named(look: Look) -> None:
    def sets(path: Path) -> dict[int, int]:
        return {57_600: 57_692, 1_000_000: 1_000_000, 4_000_000: 3_000_000}

    one = look(set_rates=sets)["baud rates of /dev/ttyUSB0"]
    assert (one.state, one.found) == (
        "worse",
        "its driver changes rates: 4000000 becomes 3000000 bit/s",
    )
    assert one.fix == "choose a rate of: 57600, 1000000"
    good = look(set_rates=lambda path: {1_000_000: 1_000_000})["baud rates of /dev/ttyUSB0"]
    assert good.state == "good"


def test_the_rates_of_a_pseudo_terminal_are_as_asked() -> None:
    master, slave = os.openpty()
    assert set_rates(Path(os.ttyname(slave))) == {rate: rate for rate in RATES}
    os.close(master)
    os.close(slave)


def test_a_good_machine_has_nothing_to_fix(look: Look) -> None:
    found = look()
    assert {one.state for one in found.values()} == {"good"}
    assert not any(one.fix for one in found.values())
    assert list(found) == [
        "system",
        "exchange",
        "/dev/ttyUSB0",
        "latency timer of ttyUSB0",
        "real-time priority",
        "locked memory",
        "kernel",
        "real-time share",
        "clock",
        "cores",
        "CPU governor",
        "idle latency",
    ]


LIMITS = "sudo tee -a /etc/security/limits.d/dxlrun.conf"
CONTAINER = "--cap-add SYS_NICE --ulimit rtprio=98 --ulimit memlock=-1"


DYNAMIC = {
    "proc/sys/kernel/osrelease": "6.18.4",
    "proc/sys/kernel/version": "#1 SMP PREEMPT_DYNAMIC Sat",
}
NONE = "# CONFIG_PREEMPT_LAZY is not set\nCONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n"
BOOTED = "BOOT_IMAGE=/vmlinuz quiet preempt=lots"


@pytest.mark.parametrize(
    ("files", "model"),
    [
        ({"boot/config-6.18.4": NONE, "proc/cmdline": BOOTED}, "none"),
        ({"boot/config-6.18.4": NONE, "proc/cmdline": f"{BOOTED} preempt=none preempt=full"}, "full"),
        ({"boot/config-6.18.4": "CONFIG_PREEMPT=y\nCONFIG_PREEMPTION=y\n"}, "full"),
        ({"boot/config-6.18.4": "CONFIG_PREEMPT_LAZY=y\n"}, "lazy"),
        ({"sys/kernel/debug/sched/preempt": "none (voluntary) full lazy", "proc/cmdline": "preempt=full"},
         "voluntary"),
        ({"boot/config-6.18.5": NONE}, None),
        ({"boot/config-6.18.4": NONE, "proc/sys/kernel/version": "#1 SMP PREEMPT_RT"}, None),
    ],
)  # fmt: skip
def test_the_preemption_of_the_kernel_is_found(
    look: Look, files: dict[str, str | None], model: str | None
) -> None:
    found = look(DYNAMIC | files)
    if model is None:
        assert "preemption" not in found
        return
    one = found["preemption"]
    assert one.found == f"preempt={model}"
    assert one.state == ("good" if model in {"full", "lazy"} else "worse")
    assert bool(one.fix) == (one.state == "worse")
    assert found["kernel"].state == "worse"


def test_the_configuration_of_the_running_kernel_may_be_compressed(look: Look, tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/config.gz").write_bytes(gzip.compress(NONE.encode()))
    assert look(DYNAMIC)["preemption"].fix == ("add preempt=full to the kernel's command line and reboot")
    (tmp_path / "proc/config.gz").write_bytes(b"\x1f\x8b")
    assert "preemption" not in look(DYNAMIC)


@pytest.mark.parametrize(
    ("files", "rights", "what", "found", "fix"),
    [
        (
            {"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16"},
            {},
            "latency timer of ttyUSB0",
            "16 ms, 1 ms is possible",
            "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
        ),
        (
            {"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "?"},
            {},
            "latency timer of ttyUSB0",
            "it cannot be read",
            "cat /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
        ),
        ({}, {"highest_priority": 0}, "real-time priority", "none is allowed", LIMITS),
        ({}, {"highest_priority": 20}, "real-time priority", "up to 20, a run needs 32", "rtprio 98"),
        ({".dockerenv": ""}, {"highest_priority": 0}, "real-time priority", "none is allowed", CONTAINER),
        ({}, {"may_schedule": lambda: False}, "real-time priority", "refused by the kernel", "sysctl"),
        (
            {"run/.containerenv": ""},
            {"may_schedule": lambda: False},
            "real-time priority",
            "refused by the kernel",
            CONTAINER,
        ),
        ({}, {"lockable": 8 << 20}, "locked memory", "only 8192 KiB may be locked", "memlock unlimited"),
        (
            {"proc/sys/kernel/version": "#1 SMP PREEMPT_DYNAMIC Sat"},
            {},
            "kernel",
            "a stock kernel (PREEMPT_DYNAMIC)",
            "install your distribution's PREEMPT_RT kernel",
        ),
        (
            {"proc/sys/kernel/version": "#1 SMP", "etc/os-release": "ID=raspbian\nID_LIKE=debian\n"},
            {},
            "kernel",
            "a stock kernel (no preemption)",
            "sudo apt install linux-image-rt-$(dpkg --print-architecture)",
        ),
        (
            {
                "proc/sys/kernel/version": "#1 SMP PREEMPT",
                "proc/device-tree/model": "Raspberry Pi 5 Model B Rev 1.0\0",
                "etc/os-release": "ID=debian\n",
            },
            {},
            "kernel",
            "a stock kernel (PREEMPT)",
            "build the Raspberry Pi's kernel with PREEMPT_RT",
        ),
        (
            {"proc/sys/kernel/version": "#1 SMP", ".dockerenv": ""},
            {},
            "kernel",
            "a stock kernel (no preemption)",
            "on the machine that runs this container",
        ),
        (
            {"proc/sys/kernel/sched_rt_runtime_us": "-1"},
            {},
            "real-time share",
            "may take all of a core",
            "sudo sysctl kernel.sched_rt_runtime_us=950000",
        ),
        (
            {"sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet"},
            {},
            "clock",
            "the clock source is hpet, slow to read",
            "clocksource=tsc",
        ),
        ({}, {"cores": 1}, "cores", "one core for all processes", "two cores"),
        (
            {"sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "powersave"},
            {},
            "CPU governor",
            "performance, powersave instead of performance",
            "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
        ),
        (
            {},
            {"may_write": lambda path: path.name != "cpu_dma_latency"},
            "idle latency",
            "runs may not keep cores awake",
            "/etc/udev/rules.d/70-dxlrun.rules",
        ),
    ],
)
def test_what_could_be_better_is_listed_with_the_command_that_fixes_it(
    *, look: Look, files: dict[str, str], rights: dict[str, Any], what: str, found: str, fix: str
) -> None:
    by_name = look(files, **rights)
    assert [one.what for one in by_name.values() if one.state != "good"] == [what]
    one = by_name[what]
    assert one.state == "worse"
    assert found in one.found
    assert fix in one.fix
    assert one.why


@pytest.mark.parametrize(
    ("group", "mode", "found", "fix"),
    [
        (
            "dialout",
            0o660,
            "it belongs to the group dialout, and anna is not in it",
            "sudo usermod -aG dialout anna",
        ),
        ("root", 0o660, "anna may not open it", 'KERNEL=="ttyUSB*", GROUP="dialout", MODE="0660"'),
        ("wheel", 0o660, "anna may not open it", "sudo tee /etc/udev/rules.d/60-dxlrun.rules"),
        ("dialout", 0o600, "anna may not open it", "sudo tee /etc/udev/rules.d/60-dxlrun.rules"),
    ],
)
def test_a_port_that_may_not_be_opened_is_missing(
    *, look: Look, monkeypatch: pytest.MonkeyPatch, group: str, mode: int, found: str, fix: str
) -> None:
    monkeypatch.setattr(Path, "group", lambda _: group)
    look()  # makes the files

    def closed(path: Path) -> bool:
        os.chmod(path, mode)
        return False

    one = look(may_write=closed)["/dev/ttyUSB0"]
    assert (one.state, one.found) == ("missing", found)
    assert fix in one.fix
    assert f"-aG {group} " not in one.fix or group == "dialout"


def test_without_an_adapter_nothing_is_wrong(look: Look) -> None:
    found = look({"dev/ttyUSB0": None, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer": None})
    assert found["ports"].state == "good"
    assert not any("latency timer" in what for what in found)


def test_what_a_machine_hides_is_not_called_bad(tmp_path: Path) -> None:
    """An empty root, as in a container without /sys: nothing is raised, nothing is called missing."""
    machine = Machine(
        platform="linux",
        root=tmp_path,
        cores=2,
        highest_priority=99,
        lockable=UNLIMITED,
        may_schedule=lambda: True,
    )
    assert [one.what for one in diagnose(machine) if one.state != "good"] == ["kernel"]


@pytest.mark.parametrize(
    ("capabilities", "priority", "memory"),
    [
        ((), "up to 99, by the limit rtprio", "all memory, by the limit memlock"),
        (("CAP_SYS_NICE", "CAP_IPC_LOCK"), "up to 99, by CAP_SYS_NICE", "all memory, by CAP_IPC_LOCK"),
    ],
)
def test_a_right_names_its_source(
    look: Look, capabilities: tuple[str, ...], priority: str, memory: str
) -> None:
    found = look(capabilities=capabilities)
    assert (found["real-time priority"].found, found["locked memory"].found) == (priority, memory)


def test_isolated_cores_are_offered_to_the_loop(look: Look) -> None:
    assert "isolated: 3" in look({"sys/devices/system/cpu/isolated": "3"})["cores"].found


@pytest.mark.parametrize(
    ("other", "found"),
    [
        ({"platform": "darwin"}, "this is darwin; robots run on Linux only"),
        ({"platform": "win32"}, "this is win32; robots run on Linux only"),
        ({"missing_calls": ("pidfd_open",)}, "this Python lacks pidfd_open"),
    ],
)
def test_another_system_is_reported_in_one_sentence(look: Look, other: dict[str, Any], found: str) -> None:
    (one,) = look(**other).values()
    assert (one.what, one.state) == ("system", "missing")
    assert found in one.found
    assert one.fix


def test_trying_a_policy_leaves_none_behind() -> None:
    before = os.sched_getscheduler(0)
    may_schedule()
    assert os.sched_getscheduler(0) == before


# The command


def test_the_doctor_looks_at_this_machine(dxlrun: Callable[..., Any]) -> None:
    said = dxlrun("doctor", "--json")
    answer = read_answer(said.out)
    shown = answer.result
    states = {check["state"] for check in shown["checks"]}
    assert said.code == (1 if "missing" in states else 0)
    assert answer.ok == ("missing" not in states)
    assert states <= {"good", "worse", "missing"}
    assert all(set(check) == {"what", "state", "found", "why", "fix"} for check in shown["checks"])
    assert all(check["fix"] for check in shown["checks"] if check["state"] != "good")


def test_the_terminal_gets_a_table_the_commands_and_a_verdict(
    dxlrun: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other = Machine(platform="linux", root=tmp_path, user="anna", may_schedule=lambda: False)
    monkeypatch.setattr(Machine, "this", lambda: other)
    said = dxlrun("doctor")
    assert said.code == 0
    lines = said.out.splitlines()
    assert lines[0].split() == ["system", "good", "Linux", "of", "an", "unknown", "version"]
    why = lines.index("locked memory: a page that was swapped out delays the loop by milliseconds")
    assert lines[why + 1].startswith("    echo 'anna - memlock unlimited' | sudo tee -a ")
    assert lines[-1] == "robots run here: 0 missing, 4 could be better"


def test_on_another_system_the_exit_code_is_one(
    dxlrun: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Machine, "this", lambda: Machine(platform="darwin"))
    said = dxlrun("doctor")
    assert said.code == 1
    assert said.out.splitlines()[-1] == "robots cannot run here yet: 1 missing, 0 could be better"


def test_an_exchange_that_is_not_compiled_is_missing(look: Look) -> None:
    found = look(compiled="its kernel is missing; install dxlrun again")["exchange"]
    assert found.state == "missing"
    assert found.fix == "install dxlrun again"


@pytest.mark.parametrize("what", ["kernel", "gate", "shared_memory"])
def test_each_compiled_part_is_looked_for(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [tmp_path / path.name if path.stem == what else path for path in c_sources.SOURCES]
    monkeypatch.setattr(c_sources, "SOURCES", sources)
    assert Machine.this().compiled == f"the compiled {what} is missing; install dxlrun again"
