"""Doctor: checks of this machine for problems that keep a robot from running, or from running smoothly."""

from __future__ import annotations

import gzip
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

from dxlrun.channels import c_sources
from dxlrun.control.realtime_grants import (
    IDLE_LATENCY,
    IPC_LOCK,
    SYS_NICE,
    UNLIMITED,
    allow,
    allow_idle_latency,
    has_capability,
    highest_priority,
    lockable_bytes,
    user,
)
from dxlrun.errors import what_and_fix
from dxlwire.port.adapters import ONBOARD_PORTS, USB_PORTS, disturbances
from dxlwire.port.latency_timer import fix, timer_ms
from dxlwire.port.rights import command_for_access, serial_group
from dxlwire.port.serial_open import is_rate, open_serial

NEEDED = ("memfd_create", "pidfd_open", "sched_setscheduler")
"""Functions of `os` that a run needs; Linux has all of them since 5.3."""
NEEDED_PRIORITY = 32
"""Real-time priority that a run needs: default of the loop in the robot file, plus one for the guardian."""
RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
"""Baud rates that are tried at each port, bit/s: those of servos (e-Manual, Baud Rate)."""
FAST_MS = 1
"""Shortest latency timer of an FTDI adapter, ms (FTDI application note AN232B-04)."""

_CAPABILITIES = {SYS_NICE: "CAP_SYS_NICE", IPC_LOCK: "CAP_IPC_LOCK"}
_REAL_TIME_KERNELS = {
    "debian": "sudo apt install linux-image-rt-$(dpkg --print-architecture)",
    "ubuntu": "sudo pro enable realtime-kernel",
    "arch": "sudo pacman -S linux-rt",
}
_RASPBERRY_PI = "proc/device-tree/model"
_REAL_TIME_KERNELS_OF_PI = {
    "debian": "build the Raspberry Pi's kernel with PREEMPT_RT: docs/explanation/real-time.md",
    "ubuntu": "sudo pro enable realtime-kernel --variant=raspi",
}
"""Debian's own kernel does not start on every Raspberry Pi [i]."""
_CONTAINER = "start the container with --cap-add SYS_NICE --ulimit rtprio=98 --ulimit memlock=-1"
_PREEMPTIONS = ("none", "voluntary", "full", "lazy")
"""Values of `preempt=` on the kernel's command line (Documentation/admin-guide/kernel-parameters.txt)."""
_SHARE = "proc/sys/kernel/sched_rt_runtime_us"
_DEFAULT_SHARE = "sudo sysctl kernel.sched_rt_runtime_us=950000"
_CLOCK_SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
_SLOW_CLOCKS = ("hpet", "acpi_pm", "pit", "jiffies", "refined-jiffies")
"""Clock sources that are read over a bus, in a microsecond or more, or that only count ticks [i]."""
_TIMERS = "sys/bus/usb-serial/devices/*/latency_timer"
_GOVERNORS = "sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"

State = Literal["good", "worse", "missing"]
"""Result of a check. worse: robots run, but less smoothly than possible; missing: no robot can run."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check; its fields are those of `dxlrun doctor --json`."""

    what: str
    state: State
    found: str
    """Observed state of this machine, as text."""
    why: str
    """Reason why the state matters to a robot, as text."""
    fix: str = ""
    """Command or step that fixes the problem; empty if there is no problem or no fix."""


@dataclass(frozen=True, slots=True)
class _Check:
    """Subject of a check and why it matters to a robot; its methods make a Finding with the state."""

    what: str
    why: str

    def good(self, found: str) -> CheckResult:
        return CheckResult(self.what, "good", found, self.why)

    def worse(self, found: str, fix: str) -> CheckResult:
        return CheckResult(self.what, "worse", found, self.why, fix)

    def missing(self, found: str, fix: str) -> CheckResult:
        return CheckResult(self.what, "missing", found, self.why, fix)


def may_schedule() -> bool:
    """Return whether the kernel grants real-time scheduling, by requesting it for a moment.

    A container's control group may have no real-time share even when the limits allow the policy.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError):
        return False
    return True


def set_rates(port: Path) -> Mapping[int, int]:
    """Set each of `RATES` at a free port; return the rate that the driver then has for each, bit/s.

    Empty if the port cannot be opened.
    """
    found: dict[int, int] = {}
    with suppress(OSError), open_serial(str(port), RATES[0]) as line:
        for rate in RATES:
            line.set_rate(rate)
            found[rate] = line.baud_rate
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Properties of a machine and its user that the checks read; tests construct other machines."""

    platform: str = sys.platform
    root: Path = Path("/")
    missing_calls: tuple[str, ...] = ()
    user: str = "nobody"
    cores: int = 1
    """Number of processor cores on which this process may run."""
    capabilities: tuple[str, ...] = ()
    """Names of the Linux capabilities CAP_SYS_NICE and CAP_IPC_LOCK that this process has."""
    highest_priority: int = 0
    """Highest real-time priority that may be requested; 99 with the capability, 0 if none."""
    lockable: int = 0
    """Memory that may be locked, bytes; UNLIMITED with the capability."""
    compiled: str = ""
    """Reason why the compiled exchange and gate cannot be used; empty when they can."""
    may_schedule: Callable[[], bool] = field(default=may_schedule)
    may_write: Callable[[Path], bool] = field(default=partial(os.access, mode=os.R_OK | os.W_OK))
    set_rates: Callable[[Path], Mapping[int, int]] = field(default=set_rates)
    """Returns the rate that a port's driver sets for each of `RATES`, bit/s; empty for a port that cannot
    be opened."""

    @classmethod
    def this(cls) -> Machine:
        """Return the properties of the machine and user that run this process; never raises."""
        missing = tuple(name for name in NEEDED if not hasattr(os, name))
        if missing or not sys.platform.startswith("linux"):
            return cls(missing_calls=missing)
        return cls(
            user=user(),
            cores=len(os.sched_getaffinity(0)),
            capabilities=tuple(name for bit, name in _CAPABILITIES.items() if has_capability(bit)),
            highest_priority=highest_priority(),
            lockable=lockable_bytes(),
            compiled=c_sources.missing(),
        )

    @property
    def container(self) -> bool:
        """True in a container. Its rights are set at its start, and its kernel is the host's."""
        return any((self.root / name).exists() for name in (".dockerenv", "run/.containerenv"))

    def read_text(self, path: str) -> str | None:
        """Return the text of a file under the root, stripped; None when it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except OSError:
            return None

    def glob(self, pattern: str) -> list[Path]:
        """Return the sorted paths under the root that match a pattern."""
        return sorted(self.root.glob(pattern))

    def format_path(self, path: Path) -> str:
        """Return a path as the machine's user would write it."""
        return f"/{path.relative_to(self.root)}"


def diagnose(machine: Machine) -> tuple[CheckResult, ...]:
    """Check a machine; return the findings in the order in which to fix them.

    If no robot can run here, only that finding is returned.
    """
    first = _system(machine)
    if first.state == "missing":
        return (first,)
    return (
        first,
        _exchange(machine),
        *_ports(machine),
        *(_timer(machine, path) for path in machine.glob(_TIMERS)),
        _priority(machine),
        _locked_memory(machine),
        _kernel(machine),
        *_preemption(machine),
        _real_time_share(machine),
        _clock_source(machine),
        _cores(machine),
        _governor(machine),
        _idle_latency(machine),
    )


def _system(machine: Machine) -> CheckResult:
    check = _Check("system", "a run is several processes with shared memory and pidfds, which need Linux")
    if not machine.platform.startswith("linux"):
        return check.missing(
            f"this is {machine.platform}; robots run on Linux only, files can be checked everywhere",
            "run the robot on a Linux machine, such as a Raspberry Pi",
        )
    if machine.missing_calls:
        return check.missing(
            f"this Python lacks {', '.join(machine.missing_calls)}", "install Linux 5.3 or newer"
        )
    return check.good(f"Linux {machine.read_text('proc/sys/kernel/osrelease') or 'of an unknown version'}")


def _exchange(machine: Machine) -> CheckResult:
    """Check the compiled parts of a cycle: the exchange with the servos, and the gate."""
    check = _Check(
        "exchange", "compiled code limits goals and exchanges bytes with the servos in every cycle"
    )
    if not machine.compiled:
        return check.good("compiled")
    return check.missing(*what_and_fix(machine.compiled))


def _ports(machine: Machine) -> Iterator[CheckResult]:
    usb, onboard = (
        [path for pattern in patterns for path in machine.glob(f"dev/{pattern}")]
        for patterns in (USB_PORTS, ONBOARD_PORTS)
    )
    if not usb:
        yield _Check("ports", "servos are connected to a serial port").good(
            "no USB serial adapter is plugged in"
        )
    for path in usb:
        yield _port(machine, path)
    for path in onboard:
        found = _port(machine, path)
        # A robot on a USB adapter does not need an onboard port.
        yield replace(found, state="worse") if found.state == "missing" else found
    for path in (*usb, *onboard):
        yield from _rates(machine, path)
    for one in disturbances(machine.root):
        yield _Check(one.what, one.why).worse(one.found, one.fix)


def _rates(machine: Machine, path: Path) -> Iterator[CheckResult]:
    """Check the rates that a port's driver sets; yields nothing for a port that cannot be opened now."""
    name = machine.format_path(path)
    check = _Check(f"baud rates of {name}", "a servo receives only packets at its own baud rate")
    found = machine.set_rates(path)
    wrong = {rate: real for rate, real in found.items() if not is_rate(real, rate)}
    if wrong:
        shown = ", ".join(f"{rate} becomes {real}" for rate, real in wrong.items())
        right = ", ".join(str(rate) for rate in found if rate not in wrong)
        fix = f"choose a rate of: {right}" if right else "use another adapter"
        yield check.worse(f"its driver changes rates: {shown} bit/s", fix)
    elif found:
        yield check.good(f"{', '.join(map(str, found))} bit/s are set exactly")


def _port(machine: Machine, path: Path) -> CheckResult:
    name = machine.format_path(path)
    check = _Check(name, "the guardian opens the port to read and to write")
    if machine.may_write(path):
        return check.good(f"{machine.user} may open it")
    group = serial_group(path)
    found = f"it belongs to the group {group}, and {machine.user} is not in it"
    return check.missing(
        found if group else f"{machine.user} may not open it", command_for_access(path, name, machine.user)
    )


def _timer(machine: Machine, path: Path) -> CheckResult:
    """Check the latency timer of an FTDI adapter; other adapters have none."""
    check = _Check(
        f"latency timer of {path.parent.name}",
        "the adapter delays the last bytes of each reply by this time",
    )
    found, shown = timer_ms(path), machine.format_path(path)
    if found is None:
        return check.worse("it cannot be read", f"cat {shown}")
    if found <= FAST_MS:
        return check.good(f"{found} ms")
    return check.worse(f"{found} ms, 1 ms is possible", fix(shown))


def _priority(machine: Machine) -> CheckResult:
    """Check that a run is allowed real-time priority (RLIMIT_RTPRIO, CAP_SYS_NICE), and receives it."""
    check = _Check(
        "real-time priority", "with ordinary priority any busy program delays the loop by milliseconds"
    )
    highest = machine.highest_priority
    if highest < NEEDED_PRIORITY:
        found = f"up to {highest}, a run needs {NEEDED_PRIORITY}" if highest else "none is allowed"
        return check.worse(found, _raise_limit(machine, "rtprio", 98))
    if not machine.may_schedule():
        return check.worse(
            "allowed, but refused by the kernel: this control group has no real-time share",
            _CONTAINER if machine.container else _DEFAULT_SHARE,
        )
    return check.good(f"up to {highest}, {_by(machine, 'CAP_SYS_NICE', 'rtprio')}")


def _locked_memory(machine: Machine) -> CheckResult:
    """Check that a run may lock all of its memory (RLIMIT_MEMLOCK, CAP_IPC_LOCK)."""
    check = _Check("locked memory", "a page that was swapped out delays the loop by milliseconds")
    if machine.lockable == UNLIMITED:
        return check.good(f"all memory, {_by(machine, 'CAP_IPC_LOCK', 'memlock')}")
    return check.worse(
        f"only {machine.lockable >> 10} KiB may be locked", _raise_limit(machine, "memlock", "unlimited")
    )


def _by(machine: Machine, capability: str, limit: str) -> str:
    return f"by {capability}" if capability in machine.capabilities else f"by the limit {limit}"


def _raise_limit(machine: Machine, limit: str, value: int | str) -> str:
    return _CONTAINER if machine.container else f"{allow(limit, value, machine.user)}  # then log in again"


def _kernel(machine: Machine) -> CheckResult:
    """Check that the kernel is a real-time kernel.

    Source of the figures: wake-ups of a 1 kHz timer under full load, 1,000,000 each, in the bachelor thesis
    on real-time control of Dynamixel servos that dxlrun follows.
    """
    check = _Check(
        "kernel",
        "under full load a stock kernel woke a 1 kHz loop up to 17 ms late, a real-time kernel 86 us",
    )
    version = machine.read_text("proc/sys/kernel/version") or ""
    if "PREEMPT_RT" in version or machine.read_text("sys/kernel/realtime") == "1":
        return check.good("a real-time kernel (PREEMPT_RT)")
    kind = next((word for word in version.split() if word.startswith("PREEMPT")), "no preemption")
    return check.worse(f"a stock kernel ({kind})", _real_time_kernel(machine))


def _preemption(machine: Machine) -> tuple[CheckResult, ...]:
    """Check that a stock kernel preempts its own work for the loop; empty when its model is unknown."""
    model = preemption(machine)
    if model is None:
        return ()
    check = _Check(
        "preemption",
        "with preempt=none or voluntary, the loop waits for system calls of other programs, whatever its "
        "priority (writing 1 MiB takes 2 ms)",
    )
    # With lazy, only ordinary programs are preempted later (kernel/Kconfig.preempt).
    if model in {"full", "lazy"}:
        return (check.good(f"preempt={model}"),)
    where = "of the machine that runs this container " if machine.container else ""
    fix = f"add preempt=full to the kernel's command line {where}and reboot"
    return (check.worse(f"preempt={model}", fix),)


def preemption(machine: Machine) -> str | None:
    """Return the preemption model of a kernel with several models (PREEMPT_DYNAMIC), else None.

    The model is in debugfs for root, else in the last `preempt=` of the command line, else in the build
    configuration. None also means that none of these shows it.
    """
    if "PREEMPT_DYNAMIC" not in (machine.read_text("proc/sys/kernel/version") or ""):
        return None
    active = re.search(r"\((\w+)\)", machine.read_text("sys/kernel/debug/sched/preempt") or "")
    if active:
        return active[1]
    words = (machine.read_text("proc/cmdline") or "").split()
    asked = [word[8:] for word in words if word.startswith("preempt=") and word[8:] in _PREEMPTIONS]
    if asked:
        return asked[-1]
    config = _kernel_config(machine)
    built = {"CONFIG_PREEMPT=y": "full"} | {f"CONFIG_PREEMPT_{one.upper()}=y": one for one in _PREEMPTIONS}
    return next((built[line] for line in config.splitlines() if line in built), None)


def _kernel_config(machine: Machine) -> str:
    """Return the build configuration of the kernel; empty when it cannot be read."""
    try:
        return gzip.decompress((machine.root / "proc/config.gz").read_bytes()).decode(errors="replace")
    except (OSError, EOFError):
        return machine.read_text(f"boot/config-{machine.read_text('proc/sys/kernel/osrelease')}") or ""


def _real_time_kernel(machine: Machine) -> str:
    """Return the step that installs a real-time kernel on this distribution."""
    if machine.container:
        return "install a PREEMPT_RT kernel on the machine that runs this container"
    lines = (machine.read_text("etc/os-release") or "").splitlines()
    ids = [line.partition("=")[2].strip('"') for line in lines if line.startswith(("ID=", "ID_LIKE="))]
    is_pi = (machine.read_text(_RASPBERRY_PI) or "").startswith("Raspberry Pi")
    kernels = _REAL_TIME_KERNELS_OF_PI if is_pi else _REAL_TIME_KERNELS
    known = [kernels[one] for words in ids for one in words.split() if one in kernels]
    return known[0] if known else "install your distribution's PREEMPT_RT kernel"


def _real_time_share(machine: Machine) -> CheckResult:
    """Check that a runaway real-time loop leaves a share of its core to other programs (sched(7))."""
    check = _Check(
        "real-time share",
        "a real-time loop that never sleeps would block all other programs on its core, also your shell",
    )
    share = machine.read_text(_SHARE)
    if share == "-1":
        return check.worse("real-time processes may take all of a core", _DEFAULT_SHARE)
    if share is None or not share.isdigit():
        return check.good("the kernel does not show it")
    return check.good(f"at most {int(share) / 1e4:g} % of a core")


def _clock_source(machine: Machine) -> CheckResult:
    check = _Check("clock", "the loop polls the clock shortly before each deadline")
    source = machine.read_text(_CLOCK_SOURCE)
    if source in _SLOW_CLOCKS:
        return check.worse(
            f"the clock source is {source}, slow to read",
            "add clocksource=tsc to the kernel's command line and reboot",
        )
    return check.good(f"the clock source is {source or 'not shown'}")


def _cores(machine: Machine) -> CheckResult:
    """Check that the loop can have its own core."""
    check = _Check("cores", "guardian, recorder and gateway work next to the loop")
    if machine.cores < 2:
        return check.worse(
            "one core for all processes",
            "use a machine with two cores or more, or allow this process to use two",
        )
    isolated = machine.read_text("sys/devices/system/cpu/isolated")
    also = f"; isolated: {isolated} (write them in loop.scheduler.cores for the loop)" if isolated else ""
    return check.good(f"{machine.cores} cores{also}")


def _governor(machine: Machine) -> CheckResult:
    """Check that the cores always run at their full clock rate."""
    check = _Check("CPU governor", "a core at a low clock rate makes the first milliseconds of work slow")
    found = sorted({path.read_text().strip() for path in machine.glob(_GOVERNORS)})
    if not found:
        return check.good("this machine has no governor, or does not show it")
    if found == ["performance"]:
        return check.good("performance on all cores")
    return check.worse(
        f"{', '.join(found)} instead of performance",
        f"echo performance | sudo tee /{_GOVERNORS.replace('[0-9]', '')}",
    )


def _idle_latency(machine: Machine) -> CheckResult:
    """Check that a run may keep the cores out of deep idle states."""
    check = _Check(
        "idle latency",
        "a core in a deep idle state wakes up to some 100 us late; "
        "loop.scheduler.idle_latency keeps it awake",
    )
    device = machine.root / IDLE_LATENCY.relative_to("/")
    if not device.exists():
        return check.good("this machine has no idle states, or does not show them")
    if machine.may_write(device):
        return check.good("runs may keep cores awake")
    return check.worse("runs may not keep cores awake", allow_idle_latency(machine.user))
