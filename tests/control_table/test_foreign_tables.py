from __future__ import annotations

import importlib.util
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rustypot

from dxlrun.control_table import ControlTable, all_tables, control_table, models_by_number
from dxlrun.control_table.protocol2 import sdk_files

Places = Callable[[ControlTable], dict[str, tuple[int, int, bool]]]
OTHER_NAMES = {"baudrate": "baud_rate"}
ONLY_HERE = {
    "MX-106": {"drive_mode", "current", "torque_ctrl_mode_enable", "goal_torque"},
    "MX-64": {"current", "torque_ctrl_mode_enable", "goal_torque"},
}
"""Items of the manual that the foreign list of all MX does not have."""


def _foreign(controller: Any) -> dict[str, tuple[int, int, bool]]:
    return {
        OTHER_NAMES.get(each.name, each.name): (
            each.addr,
            each.size,
            each.access == rustypot.RegisterAccess.ReadWrite,
        )
        for each in controller.registers()
    }


@pytest.mark.parametrize(
    "model", ["AX-12A", "AX-12W", "AX-18A", "RX-24F", "RX-28", "RX-64", "DX-113", "DX-117"]
)
def test_ax_rx_and_dx_stand_where_a_foreign_list_has_them(model: str, places: Places) -> None:
    assert places(control_table(model)) == _foreign(rustypot.AxPyController)


@pytest.mark.parametrize("model", ["MX-12W", "MX-28", "MX-64", "MX-106"])
def test_mx_stands_where_a_foreign_list_has_it(model: str, places: Places) -> None:
    ours = places(control_table(model, 1.0))
    foreign = _foreign(rustypot.MxPyController)
    assert foreign.items() <= ours.items()
    assert ours.keys() - foreign.keys() == ONLY_HERE.get(model, set())


def test_xl_320_stands_where_a_foreign_list_has_it(places: Places) -> None:
    foreign = _foreign(rustypot.Xl320PyController)
    foreign["registered_instruction"] = foreign.pop("registered")  # the name in the manual's table
    assert places(control_table("XL-320")) == foreign


def test_x430_stands_where_a_foreign_list_has_it(places: Places) -> None:
    ours = places(control_table("XM430-W350"))
    foreign = _foreign(rustypot.Xl430PyController)
    foreign["secondary_shadow_id"] = foreign.pop("secondary_id")
    common = foreign.keys() & ours.keys()
    assert {name: ours[name] for name in common} == {name: foreign[name] for name in common}
    assert len(common) > 50
    assert foreign.keys() - ours.keys() <= {"startup_configuration", "backup_ready"}  # newer firmware


@pytest.mark.parametrize(
    "controller", [rustypot.AxPyController, rustypot.MxPyController, rustypot.Xl430PyController]
)
def test_model_numbers_are_those_of_a_foreign_list(controller: Any) -> None:
    protocol = 2.0 if controller is rustypot.Xl430PyController else 1.0
    for name, number in controller.models().items():
        (table,) = models_by_number(number, protocol)
        wanted = {"AX12": "AX12A", "XL430W2502": "2XL430W250"}.get(name, name)
        assert table.model.replace("-", "") == wanted


def _sdk_rows(path: Path) -> dict[str, tuple[int, int]]:
    rows = path.read_text("utf-8").split("[control table]")[1].strip().splitlines()[1:]
    split = [row.split("\t") for row in rows]
    return {name.strip(): (int(address), int(size)) for address, size, name in split}


def test_every_model_of_the_sdk_is_there() -> None:
    files = sdk_files()
    assert len(files) == 67
    assert len([table for table in all_tables() if table.protocol == 2.0]) == len(files)


def test_every_number_of_the_sdk_leads_to_a_table_with_its_cells() -> None:
    folder = sdk_files()[0].parent
    lines = (folder / "dynamixel.model").read_text("utf-8").splitlines()[1:]
    for line in lines:
        number, name = line.split("\t")
        older = models_by_number(int(number), 2.0)[-1]  # the file without a firmware in its name
        cells = {(item.address, item.size) for item in older.items.values()}
        assert set(_sdk_rows(folder / name.strip()).values()) <= cells, name


def test_each_correction_of_the_sdk_says_why(data_files: Path) -> None:
    layers = tomllib.loads((data_files / "protocol2" / "sdk_corrections.toml").read_text("utf-8"))["layers"]
    assert layers
    for layer in layers:
        assert len(layer["reason"].split()) > 10
        assert layer["models"]


def test_the_sdk_is_still_wrong_about_what_we_correct() -> None:
    folder = sdk_files()[0].parent
    assert "value_of_max_radian_position\t4095" in (folder / "xl320.model").read_text("utf-8")
    assert "value_of_min_radian_position\t0" in (folder / "xm430_w350.model").read_text("utf-8")
    assert "262144" in (folder / "ym070_210_r051.model").read_text("utf-8")
    assert "xw430_t200" not in (folder / "dynamixel.model").read_text("utf-8")


def test_tables_are_read_without_importing_the_sdk_or_anything_heavy() -> None:
    code = (
        "import sys; from dxlrun.control_table import all_tables; assert len(all_tables()) > 60;"
        "heavy = {'numpy', 'pydantic', 'yaml', 'serial', 'dynamixel_easy_sdk', 'dynamixel_sdk'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert importlib.util.find_spec("dynamixel_easy_sdk") is not None
