from __future__ import annotations

import re
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_text

import dxlwire
from dxlrun.cli.tools.models import runs, unit_of
from dxlrun.contract.hookspecs import HookSpecs
from dxlwire.control_table import all_tables, find_table
from dxlwire.control_table.device_models import device_tables


def test_without_a_name_all_models_are_listed(dxlrun):
    said = dxlrun("models")

    assert (said.code, said.err) == (0, "")
    for table in all_tables():
        assert f"\n{table.model} " in said.out
    (line,) = (line for line in said.out.splitlines() if line.startswith("XM430-W350 "))
    assert line.split() == [
        *("XM430-W350", "1020", "2.0", "0.0879", "deg", "0..359.9", "deg", "46", "rpm", "4.1", "Nm"),
        *("present", "current", "in", "A"),
    ]


def test_a_protocol_can_be_chosen(dxlrun):
    said = dxlrun("models", "--protocol", "1.0")

    assert said.code == 0
    assert "\nAX-12A " in said.out
    assert "XM430" not in said.out


def test_a_name_prints_its_control_table(dxlrun):
    said = dxlrun("models", "AX-12A")

    assert said.code == 0
    assert said.out.startswith("AX-12A (AX-12, AX-12+): model number 12, Protocol 1.0\n")
    rows = {line.split()[0]: line.split() for line in said.out.splitlines() if line.strip()}
    assert rows["goal_position"] == [
        *("goal_position", "30", "2", "RW", "RAM", "0.2933", "deg", "0..1023", "Goal", "Position", "(30)"),
    ]
    assert rows["return_delay_time"][:9] == [
        *("return_delay_time", "5", "1", "RW", "EEPROM", "0.002", "ms", "0..254", "250"),
    ]
    assert set(find_table("AX-12A").items) <= rows.keys()


def test_another_name_prints_it_too(dxlrun):
    assert dxlrun("models", "xl-430").out.startswith("XL430-W250: model number 1060, Protocol 2.0")


@pytest.mark.parametrize(
    ("model", "line"),
    [
        (
            "XM430-W350",
            "no-load speed 46 rpm at 12 V, stall torque 4.1 Nm, stall current 2.3 A, gear 353.5 : 1",
        ),
        ("DX-113", "no-load speed 54 rpm at 12 V, stall torque 1 Nm, gear 192.6 : 1"),
        ("PH54-200-S500", "no-load speed 33.1 rpm at 24 V, stall torque not given, gear 501.92 : 1"),
        ("XW430-T333", "no-load speed 31.8 rpm, stall torque not given"),
    ],
)
def test_a_name_prints_its_motor_as_far_as_the_manual_gives_it(dxlrun, model, line):
    assert dxlrun("models", model).out.splitlines()[2] == f"motor       {line}"


def test_the_motor_that_is_simulated_is_reported_with_its_source(dxlrun):
    known = dxlrun("models", "MX-64", "--protocol", "1").out.splitlines()[3:7]
    assert known == [
        "simulated   no-load speed 68.76 rpm, time constant 15.1 ms, friction 0.1 Nm and 8% of the torque, "
        "1.63 Nm/A",
        "  source    Rhoban BAM, bam/params/mx64/m3.json",
        "P gain      0.158 of full duty per rad of error, at a gain of 1",
        "  source    Rhoban BAM, bam/dynamixel/actuator.py: 0.158, 5.06 at the P gain of 32",
    ]
    scaled = dxlrun("models", "XM430-W350").out.splitlines()[3:5]
    assert scaled == [
        "simulated   no-load speed 46 rpm, time constant 15.1 ms, friction 0.076 Nm and 8% of the torque, "
        "1.78 Nm/A",
        "  source    [i] scaled from the MX-64: Rhoban BAM, bam/params/mx64/m3.json",
    ]
    (shown,) = result_of(dxlrun("models", "XL330-M077", "--json").out)
    motor = shown["simulated_motor"]
    assert (motor["time_constant"], motor["p_gain_duty"]) == pytest.approx((0.0448, 0.0028774), rel=1e-2)
    assert motor["source"].startswith("[i] scaled from the XL330-M288: ")
    assert motor["gain_source"].startswith("[i] as XL330-M288; ")


def test_a_name_of_both_protocols_prints_both_tables(dxlrun):
    both = dxlrun("models", "MX-28")
    second = dxlrun("models", "MX-28", "--protocol", "2")

    assert "model number 29, Protocol 1.0" in both.out
    assert "model number 30, Protocol 2.0" in both.out
    assert second.out in both.out
    assert second.out.startswith("MX-28 (MX-28(2.0), ")


def test_items_that_repeat_themselves_share_a_line(dxlrun):
    said = dxlrun("models", "XM430-W350")

    (line,) = (line for line in said.out.splitlines() if line.split()[:1] == ["indirect_address_1..28"])
    assert "168..222" in line
    assert "224..251" in line
    names = [item.name for run in runs(tuple(find_table("XM430-W350").items.values())) for item in run]
    assert names == list(find_table("XM430-W350").items)


def test_json_of_one_model_holds_all_that_the_table_knows(dxlrun):
    (shown,) = result_of(dxlrun("models", "XM430-W350", "--json").out)

    table = find_table("XM430-W350")
    assert shown["rad_per_tick"] == table.rad_per_tick
    motor = {name: shown[name] for name in ("stall_torque", "stall_current", "nominal_voltage", "gear_ratio")}
    assert motor == {"stall_torque": 4.1, "stall_current": 2.3, "nominal_voltage": 12.0, "gear_ratio": 353.5}
    assert shown["capabilities"] == sorted(table.capabilities)
    assert shown["baud_rates"]["3"] == 1_000_000
    items = {item["name"]: item for item in shown["items"]}
    assert list(items) == list(table.items)
    assert items["id"] == {
        "name": "id", "address": 7, "size": 1, "access": "RW", "area": "EEPROM", "minimum": 0, "maximum": 252,
        "initial": 1, "encoding": "unsigned", "unit": "", "scale": 1.0, "page": "ID (7)",
        "firmware": 0,
        "deviation": {
            "judgement": "harmless", "effect": "the servo is addressed by it", "bits": [], "refused": [],
            "refused_effect": "", "equivalent": [], "planned": False, "limited_by": "",
            "remedy": "declare what the robot needs in `registers`, or write it by `dxlrun servo`",
        },
    }  # fmt: skip


def test_json_of_all_models_has_no_items(dxlrun):
    shown = result_of(dxlrun("models", "--json").out)

    assert [(each["model"], each["protocol"]) for each in shown if each["kind"] == "servo"] == [
        (table.model, table.protocol) for table in all_tables()
    ]
    assert [each["model"] for each in shown if each["kind"] == "device"] == [
        table.model for table in device_tables()
    ]
    assert all("items" not in each for each in shown)


def test_a_device_is_printed_with_its_states(dxlrun):
    said = dxlrun("models", "opencr")
    assert said.code == 0
    assert "OpenCR (OPEN-CR): model number 29696, Protocol 2.0" in said.out
    row = next(line for line in said.out.splitlines() if line.startswith("gyro_x"))
    assert row.split()[1:] == [
        "32", "2", "R", "RAM", "0.06098", "deg/s", "-32768..32767", "angular_velocity.x", "GYRO", "X/Y/Z",
    ]  # fmt: skip
    assert "button.user" in said.out
    assert "angular_velocity.x" in dxlrun("models").out
    (shown,) = result_of(dxlrun("models", "BitFoot", "--json").out)
    assert (shown["kind"], shown["model_number"], len(shown["items"])) == ("device", None, 8)
    said = dxlrun("models", "OpenCR", "--protocol", "1.0")
    assert (said.code, said.errors) == (2, [said.errors[0]])
    assert "did you mean CM-740?" in dxlrun("models", "CM-74").err


@pytest.mark.parametrize(
    ("item", "unit"),
    [("goal_position", "0.08789 deg"), ("goal_pwm", "0.113 %"), ("present_current", "2.69 mA"), ("led", "")],
)
def test_units_are_those_that_people_read(item, unit):
    assert unit_of(find_table("XM430-W350").items[item]) == unit


PAGE = page_text("models.md")


@pytest.mark.parametrize("line", re.findall(r"^    (dxlrun .+)$", PAGE, re.MULTILINE))
def test_each_command_of_the_page_works(dxlrun, line):
    said = dxlrun(*line.split()[1:])

    assert (said.code, said.err) == (0, "")
    assert said.out


def test_the_page_shows_hooks_that_there_are():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    hooks = re.findall(r"^@hookimpl\ndef (\w+)\(\) -> (.+):$", code, re.MULTILINE)
    assert [name for name, _ in hooks] == ["dxlrun_contract", "dxlrun_servo_models"]
    assert all(hasattr(HookSpecs, name) for name, _ in hooks)
    compile(code, "models.md", "exec")


def test_the_page_names_files_that_there_are():
    folder = Path(dxlwire.__file__).parent / "control_table" / "tables"
    for name in re.findall(r"`(\w[\w-]*\.toml)`", PAGE):
        assert list(folder.rglob(name)), name
