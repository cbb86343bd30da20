"""`dxlrun characterize` as a command: on virtual time, on a run of its own, and refused."""

from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_commands, page_text

from dxlrun_lab.characterize import procedure

FIGURES = {name for figures in procedure._FIGURES.values() for name, _ in figures}


pytestmark = [pytest.mark.long, pytest.mark.usefixtures("here")]


def slow_bus(tmp_path: Path) -> Path:
    """A robot whose bus allows little more than its rate."""
    bus = "port: sim, protocol: 1.0, baud_rate: 57_600, adapter: {latency: 0 ms}"
    joint = "bus: main, id: 1, model: MX-64, reference: 180 deg, direction: 1"
    file = tmp_path / "slow.yaml"
    file.write_text(
        f"name: slow\nbuses: {{main: {{{bus}}}}}\nloop: {{rate: 140}}\njoints: {{joint: {{{joint}}}}}\n"
    )
    return file


@pytest.mark.needs("report")
def test_the_commands_of_the_page_measure(dxlrun, tmp_path):
    virtual, real, running = page_commands("experiments.md", "characterize")
    done = dxlrun(*virtual)
    assert (done.code, "smallest change that moves it" in done.out) == (0, True), done.err
    page = (tmp_path / "dead_band.html").read_text()
    assert '<figure id="joint-band">' in page
    words = [word.replace("/dev/ttyUSB0", "sim") for word in real]
    done = dxlrun(*words, "--virtual", "--measure", "dead_band", "--json")
    (joint,) = result_of(done.out)["joints"]
    assert joint["range"] == pytest.approx([-1.0472, 1.0472], abs=1e-4)
    words = ["nobodys_arm" if word == "arm" else word for word in running]  # others may run an arm meanwhile
    assert "robot nobodys_arm is not running" in dxlrun(*words).err


def test_a_run_of_its_own_gives_the_same_table(dxlrun, tmp_path, monkeypatch):
    """In real time, so the figures depend on the machine: only what is there, and that it is consistent."""
    monkeypatch.setattr(procedure, "_RATE_S", 0.2)
    done = dxlrun("characterize", slow_bus(tmp_path), "joint", "--measure", "rate", "--json")
    result = result_of(done.out)
    assert (result["robot"], [joint["joint"] for joint in result["joints"]]) == ("slow", ["joint"])
    (figure,) = result["joints"][0]["figures"]
    assert (figure["name"], figure["unit"]) == ("highest rate", "Hz")
    tried = result["joints"][0]["rates"]
    assert [one["rate"] for one in tried] == sorted(one["rate"] for one in tried)
    if figure["value"] is not None:
        assert figure["value"] in [one["rate"] for one in tried]
        assert figure["value"] <= 1e3 / 6.229 + 0.01
        assert figure["limit"]
    else:
        assert figure["why"]


def test_every_figure_of_a_result_is_on_the_page():
    text = page_text("experiments.md").partition("## characterize")[2].partition("\n## ")[0]
    for name in FIGURES:
        assert name in text, name
