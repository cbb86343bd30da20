"""The operating system itself: whether robots run on it, and how punctually."""

from __future__ import annotations

from dxlrun.run.doctor.finding import Finding
from dxlrun.run.doctor.machine import Machine

_PACKAGES = {
    "debian": "sudo apt install linux-image-rt-$(dpkg --print-architecture)",
    "ubuntu": "sudo pro enable realtime-kernel",
    "arch": "sudo pacman -S linux-rt",
}
_SHARE = "proc/sys/kernel/sched_rt_runtime_us"
_CLOCK_SOURCE = "sys/devices/system/clocksource/clocksource0/current_clocksource"
_SLOW_CLOCKS = ("hpet", "acpi_pm", "pit", "jiffies", "refined-jiffies")
"""Sources that are read over a bus, in a microsecond or more, or that tick [i]."""


def system(machine: Machine) -> Finding:
    """Look whether this is a Linux that has all that a run needs."""
    why = "a run is several processes that share nameless memory and watch each other"
    if not machine.platform.startswith("linux"):
        return Finding(
            "system",
            "missing",
            f"this is {machine.platform}; robots run on Linux only, files can be checked everywhere",
            why,
            "run the robot from a Linux machine, which may be a small one",
        )
    if machine.missing_calls:
        absent = ", ".join(machine.missing_calls)
        return Finding("system", "missing", f"this Python has no {absent}", why, "install Linux 5.3 or newer")
    release = machine.read("proc/sys/kernel/osrelease") or "of an unknown version"
    return Finding("system", "good", f"Linux {release}", why)


def kernel(machine: Machine) -> Finding:
    """Look whether the kernel is a real-time one.

    Source of the figures: wake-ups of a 1 kHz timer under full load, 1,000,000 each, in the bachelor thesis
    on real-time control of Dynamixel servos that dxlrun follows.
    """
    why = "under full load a stock kernel woke a 1 kHz loop up to 17 ms late, a real-time kernel 86 us"
    version = machine.read("proc/sys/kernel/version") or ""
    if "PREEMPT_RT" in version or machine.read("sys/kernel/realtime") == "1":
        return Finding("kernel", "good", "a real-time kernel (PREEMPT_RT)", why)
    kind = next((word for word in version.split() if word.startswith("PREEMPT")), "no preemption")
    return Finding("kernel", "worse", f"a stock kernel ({kind})", why, _real_time_kernel(machine))


def exchange(machine: Machine) -> Finding:
    """Look whether the exchange with the servos is compiled: it is where a C compiler was at installation."""
    why = "the compiled exchange takes a fraction of the processor time of the one in Python, and can poll"
    if machine.compiled:
        return Finding("exchange", "good", "compiled", why)
    mend = "install a C compiler (Debian, Ubuntu: sudo apt install gcc), then dxlrun again"
    return Finding("exchange", "worse", "in Python: no C compiler was found at installation", why, mend)


def _real_time_kernel(machine: Machine) -> str:
    if machine.container:
        return "install a PREEMPT_RT kernel on the machine that runs this container"
    lines = (machine.read("etc/os-release") or "").splitlines()
    ids = [line.partition("=")[2].strip('"') for line in lines if line.startswith(("ID=", "ID_LIKE="))]
    known = [_PACKAGES[one] for words in ids for one in words.split() if one in _PACKAGES]
    return known[0] if known else "install your distribution's PREEMPT_RT kernel"


def real_time_share(machine: Machine) -> Finding:
    """Look whether a loop gone wild leaves the machine a share of its cores (sched(7))."""
    why = "a real-time loop that never sleeps would lock out everything else on its core, also you"
    share = machine.read(_SHARE)
    if share == "-1":
        return Finding(
            "real-time share",
            "worse",
            "real-time processes may take all of a core",
            why,
            "sudo sysctl kernel.sched_rt_runtime_us=950000",
        )
    if share is None or not share.isdigit():
        return Finding("real-time share", "good", "the kernel does not tell", why)
    return Finding("real-time share", "good", f"at most {int(share) / 1e4:g} % of a core", why)


def clock_source(machine: Machine) -> Finding:
    """Look whether reading the clock is cheap."""
    why = "the loop polls the clock shortly before each deadline"
    source = machine.read(_CLOCK_SOURCE)
    if source in _SLOW_CLOCKS:
        return Finding(
            "clock",
            "worse",
            f"the clock source is {source}, which is slow to read",
            why,
            "add clocksource=tsc to the kernel's command line and start again",
        )
    return Finding("clock", "good", f"the clock source is {source or 'not told'}", why)
