"""`dxlrun characterize` as a command: on virtual time, on a run of its own, and refused."""

import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_commands, page_text

from dxlrun_lab.characterize import procedure

FIGURES = {name for figures in procedure._FIGURES.values() for name, _ in figures}


pytestmark = [pytest.mark.long, pytest.mark.usefixtures("here")]


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


def test_every_figure_of_a_result_is_on_the_page():
    text = page_text("experiments.md").partition("## characterize")[2].partition("\n## ")[0]
    for name in FIGURES:
        assert name in text, name
