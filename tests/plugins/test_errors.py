"""A plug-in that is missing or wrong: one sentence each, with its place in the robot file.

`plain/mistakes.txt` has changes of the example's two modules, and the sentence for each.
"""

import sys
from pathlib import Path

import pytest
from tests.kit.cases import read_cases

from dxlrun.cli import main

EXAMPLE = Path(__file__).parents[2] / "plugins" / "example"
PLAIN = Path(__file__).with_name("plain")
NOT_OFFERED = "no plug-in offers the controller type easing_position_controller of head; "
CONTROLLER = (PLAIN / "controller.py").read_text()
PLUGIN = (EXAMPLE / "src/dxlrun_easing/plugin.py").read_text()
MISTAKES = [
    (*case.name.split(" => "), *(line.text for line in case.lines))
    for case in read_cases(PLAIN / "mistakes.txt")
]


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """Install the example with some text replaced, check its robot file, return the lines of the errors."""
    monkeypatch.chdir(tmp_path)

    def printed(old: str = "", new: str = "", *, install: bool = True) -> list[str]:
        assert not old or (old in CONTROLLER) != (old in PLUGIN)
        package = tmp_path / "dxlrun_easing"
        package.mkdir()
        (package / "__init__.py").touch()
        (package / "easing.py").write_text(CONTROLLER.replace(old, new) if old in CONTROLLER else CONTROLLER)
        (package / "plugin.py").write_text(PLUGIN.replace(old, new) if old in PLUGIN else PLUGIN)
        if install:
            info = tmp_path / "dxlrun_easing-0.1.0.dist-info"
            info.mkdir()
            (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dxlrun-easing\nVersion: 0.1.0\n")
            (info / "entry_points.txt").write_text("[dxlrun]\neasing = dxlrun_easing.plugin\n")
        (tmp_path / "example.yaml").write_text((EXAMPLE / "example.yaml").read_text())
        monkeypatch.syspath_prepend(tmp_path)
        code = main(["check", "example.yaml"])
        out, err = capsys.readouterr()
        assert (out, code) == ("", 2 if err else 0)
        return list(err.splitlines())

    yield printed
    for name in [name for name in sys.modules if name.startswith("dxlrun_easing")]:
        del sys.modules[name]


@pytest.mark.parametrize(("old", "new", "sentence"), MISTAKES)
def test_a_plugin_that_is_wrong(printed, old, new, sentence):
    (line,) = printed(old.replace("\\n", "\n"), new.replace("\\n", "\n"))
    if sentence.startswith("plug-in "):
        before, mark, after = line.partition("plug-in easing ")
        assert before.startswith(f"example.yaml:12:16: {NOT_OFFERED}")
        line = mark + after
    else:
        line = line.removeprefix("example.yaml:12:3: ")
    assert line == sentence or (sentence.endswith("...") and line.startswith(sentence[:-3]))


def test_a_plugin_that_is_not_installed(printed):
    (line,) = printed(install=False)
    assert line.startswith(f"example.yaml:12:16: {NOT_OFFERED}")
    assert line.endswith("?") or "install its package in this environment" in line
