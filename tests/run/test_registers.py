"""Declared registers in a whole run on virtual time: written at the start, told in the log, and there."""

from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot

ROBOT = """\
name: pair
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 500 us}
loop: {rate: 50}
joints:
  elbow:
    {bus: main, id: 4, model: XM430-W350, reference: 180 deg, direction: 1,
     registers: {return_delay_time: 0 us, temperature_limit: 70 degC, position_p_gain: 900}}
  wrist: {bus: main, id: 5, model: XM430-W350, reference: 180 deg, direction: 1}
"""


def test_a_run_begins_with_the_registers_of_the_robot_file(tmp_path):
    file, path = tmp_path / "pair.yaml", tmp_path / "run.mcap"
    file.write_text(ROBOT)
    robot = simulated_robot(file, duration_s=0.2, log=path)
    robot.run()
    log = read_log(path)
    assert [(one.source, one.text) for one in log.events if one.name == "register_written"] == [
        ("elbow", "Return Delay Time (9) was changed from 250 to 0"),
        ("elbow", "Temperature Limit (31) was changed from 80 to 70"),
        ("elbow", "Position P Gain (84) was changed from 800 to 900"),
    ]
    names = [one.name for one in log.events]
    assert names.index("register_written") < names.index("torque_on")
    memory = robot.buses[0].servo(4).registers
    held = [memory[name] for name in ("return_delay_time", "temperature_limit", "position_p_gain")]
    assert held == [0, 70, 900]
    assert robot.buses[0].servo(5).registers["position_p_gain"] == 800
