"""The packages beside dxlrun fit the version of the tree that they are built from, and refuse another one."""

import email
import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from tests.kit.awaited import DEADLINE_S

ROOT = Path(__file__).parents[1]
NAMES = ("dxlrun_view", "dxlrun_ros2")
OTHER = "9.9.0"
HATCHLING = (sys.executable, "-m", "hatchling")


def hatchling(folder: Path, target: str, output: Path) -> Path:
    """Build a package; return the file."""
    command = [*HATCHLING, "build", "-t", target, "-d", str(output)]
    built = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=DEADLINE_S
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return output / Path((built.stdout + built.stderr).split()[-1]).name


def tree(place: Path, version: str) -> Path:
    """Copy what the packages are built from, without what needs a network or ROS to be built."""
    text, own = (ROOT / "pyproject.toml").read_text(), core_version()
    place.mkdir()
    (place / "pyproject.toml").write_text(text.replace(f'version = "{own}"', f'version = "{version}"'))
    for name in NAMES:
        ignored = shutil.ignore_patterns("node_modules", "interfaces", "build", "__pycache__", "tests")
        shutil.copytree(ROOT / "plugins" / name, place / "plugins" / name, ignore=ignored)
    bundle = place / "plugins/dxlrun_view/src/dxlrun_view/page/build"
    bundle.mkdir()
    for name in ("page.js", "page.css"):  # newer than their sources, so they are not made again
        (bundle / name).write_text("")
    for folder in ("interfaces", "build/lib", "build/share"):
        (place / "plugins/dxlrun_ros2" / folder).mkdir(parents=True)
    return place


def core_version() -> str:
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])


def metadata(wheel: Path) -> tuple[str, list[str]]:
    """Return the version of a wheel, and what it needs."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (one for one in archive.namelist() if one.endswith(".dist-info/METADATA"))
        found = email.message_from_bytes(archive.read(name))
    return found["Version"], found.get_all("Requires-Dist") or []


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Wheels of the packages, of a tree of another version."""
    place = tmp_path_factory.mktemp("versions")
    copy = tree(place / "tree", OTHER)
    return {name: hatchling(copy / "plugins" / name, "wheel", place / "dist") for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_a_package_has_the_version_of_its_tree_and_pins_dxlrun_to_it(
    name: str, wheels: dict[str, Path]
) -> None:
    version, needed = metadata(wheels[name])
    assert version == OTHER
    assert needed[0] == f"dxlrun=={OTHER}"
    assert [one for one in needed if one.startswith("ros-")] or name == "dxlrun_view"


def test_an_sdist_keeps_the_version_without_its_tree(tmp_path: Path) -> None:
    copy = tree(tmp_path / "tree", OTHER)
    sdist = hatchling(copy / "plugins/dxlrun_view", "sdist", tmp_path / "dist")
    (elsewhere := tmp_path / "elsewhere").mkdir()
    # tarfile has its filters, without which 3.12 warns, since 3.11.4.
    subprocess.run([str(shutil.which("tar")), "-xf", sdist, "-C", elsewhere], check=True, timeout=DEADLINE_S)
    (unpacked,) = elsewhere.iterdir()
    found = json.loads(subprocess.check_output([*HATCHLING, "metadata"], cwd=unpacked, timeout=DEADLINE_S))
    assert (found["version"], found["dependencies"]) == (OTHER, [f"dxlrun=={OTHER}"])


def pip_install(wheel: Path, site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Install a wheel into a folder, without a network."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-index",
        "--target",
        str(site),
        *options,
        str(wheel),
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=DEADLINE_S)


def test_pip_does_not_install_a_package_without_its_version_of_dxlrun(
    wheels: dict[str, Path], tmp_path: Path
) -> None:
    refused = pip_install(wheels["dxlrun_view"], tmp_path / "site")
    assert refused.returncode != 0
    assert f"No matching distribution found for dxlrun=={OTHER}" in refused.stderr


def started(name: str, site: Path) -> subprocess.CompletedProcess[str]:
    """Start the program of a package beside this dxlrun."""
    code = {
        "dxlrun_view": "from dxlrun.cli import main; sys.exit(main(['view', 'nothing.mcap']))",
        "dxlrun_ros2": "from dxlrun_ros2.start import main; sys.exit(main())",
    }[name]
    command = [sys.executable, "-P", "-c", f"import sys; {code}"]
    environment = os.environ | {"PYTHONPATH": str(site), "COLUMNS": "200"}
    return subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment, timeout=DEADLINE_S, cwd=site
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_package_refuses_another_version_of_dxlrun(
    name: str, wheels: dict[str, Path], tmp_path: Path
) -> None:
    assert pip_install(wheels[name], tmp_path, "--no-deps").returncode == 0
    ran = started(name, tmp_path)
    own, dashed = core_version(), name.replace("_", "-")
    assert ran.returncode == 2, ran.stderr
    assert "Traceback" not in ran.stderr
    said = " ".join(ran.stderr.split())
    assert f"{dashed} {OTHER} needs dxlrun {OTHER}, but dxlrun {own} is installed" in said
    assert f"`pip install {dashed}=={own}`" in said


def test_a_package_of_the_same_version_starts(tmp_path: Path) -> None:
    copy = tree(tmp_path / "tree", core_version())
    wheel = hatchling(copy / "plugins/dxlrun_view", "wheel", tmp_path / "dist")
    assert pip_install(wheel, tmp_path / "site", "--no-deps").returncode == 0
    ran = started("dxlrun_view", tmp_path / "site")
    assert ran.returncode == 2
    assert "nothing.mcap" in ran.stderr
    assert "needs dxlrun" not in ran.stderr
