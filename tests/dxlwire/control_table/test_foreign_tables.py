"""Our control tables against those of others: rustypot, the maker's SDK, and its examples."""

import importlib.util
import math
import re
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import rustypot

from dxlwire.control_table import ControlTable, all_tables, find_table, models_by_number

PRO = {
    "L42-10-S300-R": 35072, "L54-30-S400-R": 37928, "L54-30-S500-R": 37896, "L54-50-S290-R": 38176,
    "L54-50-S500-R": 38152, "M42-10-S260-R": 43288, "M54-40-S250-R": 46096, "M54-60-S250-R": 46352,
    "H42-20-S300-R": 51200, "H54-100-S500-R": 53768, "H54-200-S500-R": 54024, "RH-P12-RN": 35073,
}  # fmt: skip
"""PRO before (A) and the first gripper; numbers: e-Manual, dynamixel-workbench 2eb370f, dynamixel_item.h."""
OWN = {"XM335-T323": 1710, "XC335-T332": 1700} | PRO
"""Models of Protocol 2.0 that the SDK has no file of; numbers: e-Manual, dynamixel_hardware_interface."""
Places = dict[str, tuple[int, int, bool]]
OLD_MODELS = ["AX-12A", "AX-12W", "AX-18A", "RX-24F", "RX-28", "RX-64", "DX-113", "DX-117"]
OTHER_NAMES = {"baudrate": "baud_rate", "secondary_id": "secondary_shadow_id"}
OF_MX = {"current", "torque_ctrl_mode_enable", "goal_torque"}
ONLY_HERE = {"MX-106": {"drive_mode", *OF_MX}, "MX-64": OF_MX}
"""Items of the manual that the foreign list of all MX does not have."""


def places(model: str, protocol: float | None = None) -> Places:
    """Item -> address, size, writable."""
    items = find_table(model, protocol).items
    return {name: (item.address, item.size, item.access == "RW") for name, item in items.items()}


def foreign(controller: Any, **renamed: str) -> Places:
    names, writable = OTHER_NAMES | renamed, rustypot.RegisterAccess.ReadWrite
    return {
        names.get(each.name, each.name): (each.addr, each.size, each.access == writable)
        for each in controller.registers()
    }


def test_tables_stand_where_a_foreign_list_has_them() -> None:
    for model in OLD_MODELS:
        assert places(model) == foreign(rustypot.AxPyController), model
    for model in ("MX-12W", "MX-28", "MX-64", "MX-106"):
        ours, theirs = places(model, 1.0), foreign(rustypot.MxPyController)
        assert theirs.items() <= ours.items()
        assert ours.keys() - theirs.keys() == ONLY_HERE.get(model, set()), model
    # the name in the manual's table
    assert places("XL-320") == foreign(rustypot.Xl320PyController, registered="registered_instruction")
    ours, theirs = places("XM430-W350"), foreign(rustypot.Xl430PyController)
    assert len(theirs) > 50
    assert theirs.keys() <= ours.keys()
    assert {name: ours[name] for name in theirs} == theirs


@pytest.mark.parametrize("kind", ["Ax", "Mx", "Xl430"])
def test_model_numbers_are_those_of_a_foreign_list(kind: str) -> None:
    numbers = getattr(rustypot, f"{kind}PyController").models()
    assert numbers
    for name, number in numbers.items():
        (table,) = models_by_number(number, 2.0 if kind == "Xl430" else 1.0)
        wanted = {"AX12": "AX12A", "XL430W2502": "2XL430W250"}.get(name, name)
        assert table.model.replace("-", "") == wanted


# The maker's SDK


def sdk_folder() -> Path:
    """Return the data files of dynamixel-sdk; its __init__, with all of its code, is not run."""
    found = importlib.util.find_spec("dynamixel_easy_sdk")
    assert found is not None
    assert found.submodule_search_locations
    return Path(found.submodule_search_locations[0]) / "control_table"


FOLDER = sdk_folder()
FILES = [path for path in sorted(FOLDER.glob("*.model")) if path.name != "dynamixel.model"]
"""One a model."""
NUMBERS = (FOLDER / "dynamixel.model").read_text("utf-8")


def files(patterns: Sequence[str]) -> list[Path]:
    return [path for path in FILES if any(fnmatch(path.stem, pattern) for pattern in patterns)]


def cells_of(path: Path) -> set[tuple[int, int]]:
    """Return address and size of each item of an SDK file."""
    rows = path.read_text("utf-8").split("[control table]")[1].strip().splitlines()[1:]
    return {(int(address), int(size)) for address, size, _ in (row.split("\t") for row in rows)}


def table_of(path: Path) -> ControlTable:
    """Return the table of an SDK file; of two by firmware, the newer one has the plain name."""
    name = re.sub("-RA$", "-R(A)", path.stem.removesuffix("_fw52").upper().replace("_", "-"))
    if path.stem.endswith("_fw52") or not path.with_name(f"{path.stem}_fw52.model").exists():
        return find_table({"RH-P12-RN": "RH-P12-RN(A)", "XL320": "XL-320"}.get(name, name), 2.0)
    return find_table(f"{name}-FW51", 2.0)


def test_every_model_of_the_sdk_is_there_and_those_that_it_lacks() -> None:
    assert len(FILES) == 67
    tables = [table for table in all_tables() if table.protocol == 2.0 and table.model not in OWN]
    assert len(tables) == len(FILES)
    for line in NUMBERS.splitlines()[1:]:
        number, name = line.split("\t")
        older = models_by_number(int(number), 2.0)[-1]  # the file without a firmware in its name
        cells = {(item.address, item.size) for item in older.items.values()}
        assert cells_of(FOLDER / name.strip()) <= cells, name
    for model, number in OWN.items():
        (table,) = models_by_number(number, 2.0)
        assert (table, table.model) == (find_table(model), model)
        assert f"{number}\t" not in NUMBERS


X430_X540 = ("2x*", "x[lc]430_*", "x[mh]430_*", "x[mh]540_*", "xw430_*", "xw540_t*")
"""SDK files of the models of items_XL, _XM, _EXTXM, _XH, _EXTXH and _XW."""


@pytest.mark.parametrize(
    ("patterns", "ends"),
    [
        (("x?430_*", "x?540_*", "2x*", "mx_*"), (1, 2)),
        (("x?330_*",), (2, 22)),
        (("p[hm]*", "*_ra", "rh_p12_rn"), (2, 10)),
        (("ym*",), (2, 2)),
    ],
)
def test_the_range_of_protocol_type_is_that_of_the_series(
    patterns: Sequence[str], ends: tuple[int, int]
) -> None:
    # e-Manual, Protocol Type(13): "1 ~ 2" for X430, X540 and MX(2.0), "2 ~ 22" for X330 and X335
    found = [table_of(path).items.get("protocol_type") for path in files(patterns)]
    assert {(item.minimum, item.maximum) for item in found if item is not None} == {ends}


STARTUP = {(60, 1): "startup_configuration", (147, 1): "backup_ready"}


@pytest.mark.parametrize(
    ("patterns", "count", "items", "firmware"),
    [
        # dynamixel-workbench 2eb370f, dynamixel_item.cpp, items_XL to items_XW; e-Manual, X430 and X540,
        # Startup Configuration(60) and Backup Ready(147): "available from firmware V45"
        (X430_X540, 21, STARTUP, 45),
        # not in dynamixel-workbench; the same sections of the e-Manual
        (("xd*", "xw540_h*"), 5, STARTUP, 45),
        # items_X330; e-Manual, XL330 and XC330: "available from firmware V46"
        (("x[lc]330_*",), 12, STARTUP, 46),
        # items_EXTGripper
        (
            ("rh_p12_rn",),
            1,
            {(10, 1): "drive_mode"} | {(598 + 2 * n, 2): f"external_port_data_{n}" for n in range(1, 5)},
            0,
        ),
    ],
    ids=["X430 and X540", "XD and XW540-H", "X330", "RH-P12-RN(A)"],
)
def test_what_the_sdk_omits_and_the_maker_lists_elsewhere_is_there(
    patterns: Sequence[str], count: int, items: dict[tuple[int, int], str], firmware: int
) -> None:
    assert len(files(patterns)) == count
    for path in files(patterns):
        assert not items.keys() & cells_of(path), f"{path.stem} has it by now"
        table = table_of(path)
        for (address, size), name in items.items():
            item = table.items[name]
            assert (item.address, item.size, item.firmware) == (address, size, firmware), path.stem
            assert name in table.with_firmware(firmware).items
            assert name not in table.with_firmware(firmware - 1).items


@pytest.mark.parametrize(
    ("patterns", "address"),
    [
        # Acceleration Limit: the newer pages of these models in the e-Manual have it no more
        (X430_X540, 40),
        # a misprint: the e-Manual, and so the SDK, have Torque Limit of the XL-320 at 35
        (("xl320",), 34),
    ],
)
def test_what_dynamixel_workbench_lists_and_the_manual_does_not_is_not_taken_over(
    patterns: Sequence[str], address: int
) -> None:
    assert files(patterns)
    for path in files(patterns):
        assert address not in {item.address for item in table_of(path).items.values()}


def test_mx_of_protocol_2_has_no_startup_configuration_in_any_source() -> None:
    # e-Manual, MX-28(2.0) to MX-106(2.0); dynamixel-workbench, items_MX2 and items_EXTMX2; the SDK's files
    for model in ("MX-28", "MX-64", "MX-106"):
        assert not set(STARTUP.values()) & find_table(model, 2.0).items.keys()


# The maker's examples


@pytest.mark.parametrize("model", PRO)
def test_pro_stands_where_the_maker_s_examples_address_it(model: str) -> None:
    # DynamixelSDK 2ded684d, c++/example/protocol2.0: read_write.cpp (PRO_SERIES), indirect_address.cpp;
    # Dynamixel2Arduino, actuator.cpp, pro_r_control_table
    ours, addresses = places(model), {
        "torque_enable": 562, "led_red": 563, "goal_position": 596, "moving": 610, "present_velocity": 615,
        "indirect_address_1": 49, "indirect_address_256": 559, "indirect_data_1": 634,
        "indirect_data_256": 889,
    }  # fmt: skip
    assert {name: ours[name][0] for name in addresses} == addresses
    assert ours["present_position"] == (611, 4, False)
    assert (ours["present_current"][:2], ours["goal_torque"][:2]) == ((621, 2), (604, 2))


@pytest.mark.parametrize("model", sorted(PRO.keys() - {"L42-10-S300-R", "RH-P12-RN"}))
def test_pro_counts_its_speed_in_turns_of_the_motor_a_minute(model: str) -> None:
    # e-Manual, Goal Velocity(600): 1 is one turn a minute before the gear; Specifications, Gear Ratio
    table = find_table(model)
    for name in ("goal_velocity", "present_velocity", "velocity_limit", "moving_threshold"):
        assert table.items[name].scale == pytest.approx(math.tau / 60 / table.gear_ratio, rel=3e-4), name
