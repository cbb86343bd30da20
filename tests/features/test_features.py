"""Features: the registry, and the files that it finds."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import dxlrun.features
from dxlrun.compile.contribution import CompileStage
from dxlrun.description.robot import Robot, robot_form
from dxlrun.features import FEATURES, stages
from dxlrun.features.feature import Feature, Section
from dxlrun.installed_plugins import InstalledPlugin


def test_each_feature_has_the_section_of_its_name() -> None:
    sections = {feature.name: section for feature, section in stages(Section, FEATURES)}
    assert {name: section.name for name, section in sections.items()} == {name: name for name in sections}
    assert robot_form().model_fields.keys() - Robot.model_fields.keys() == sections.keys()


def test_feature_without_file_takes_no_part_in_stage() -> None:
    assert Feature("empty", "dxlrun.messages").stage(CompileStage) is None


def test_broken_file_of_feature_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "broken_feature"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "form.py").write_text("import module_that_is_not_there\n")
    (package / "compile.py").write_text("STAGE = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    feature = Feature("broken", "broken_feature")
    with pytest.raises(ModuleNotFoundError, match="module_that_is_not_there"):
        feature.stage(Section)
    with pytest.raises(TypeError, match=r"STAGE of broken_feature.compile is a int, not a CompileStage"):
        feature.stage(CompileStage)


@pytest.mark.parametrize(
    "feature", [feature for feature, _ in stages(Section, FEATURES)], ids=lambda each: each.name
)
def test_form_of_feature_imports_no_file_of_the_run(feature: Feature) -> None:
    code = (
        f"import sys, {feature.package}.form; "
        "print(*sys.modules.keys() & {'dxlrun.compile', 'dxlrun.control', 'dxlrun.dynamixel', 'numpy'})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_broken_section_of_plugin_leaves_robots_usable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "wrong_plugin.py").write_text(
        "from dxlrun.features.feature import Feature\n"
        "def dxlrun_features():\n"
        "    return [Feature('lamps', 'wrong_plugin'), Feature('devices', 'dxlrun.features.devices')]\n"
    )
    plugin = InstalledPlugin("wrong", "wrong 1.0", EntryPoint("wrong", "wrong_plugin", "dxlrun"))
    installed, broken = dxlrun.features._installed((plugin,))
    assert installed == FEATURES
    assert broken.keys() == {"lamps", "devices"}
    assert "is there already" in broken["devices"]
