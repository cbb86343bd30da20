"""Build hooks: version of the source tree, and ROS 2 message packages that have no wheels."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sysconfig
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

USED = re.compile(r"__rosidl_(generator|typesupport_\w*c\b)|librosidl|librcutils|librcpputils|fastcdr")
"""Names of the shared libraries of other ROS 2 packages that the compiled messages are linked against"""
SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
"""Type supports (message descriptions) that ROS 2's middleware loads, each from a separate library"""
NEEDED = "the compilers gcc and g++ and Python's headers (sudo apt install build-essential python3-dev)"


class InterfacePackages(BuildHookInterface[Any]):
    """Build hook of the wheel: adds a compiled message package for each directory of interfaces/, and the
    index in which ROS 2 tools find them."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generate and compile the outdated message packages, if a wheel is built."""
        if self.target_name != "wheel":
            return
        root = Path(self.root)
        made = root / "build"
        build_data.update(infer_tag=True, pure_python=False)
        included = build_data["force_include_editable" if version == "editable" else "force_include"]
        for source in sorted((root / "interfaces").iterdir()):
            package, share = made / "packages" / source.name, made / "share"
            newest = max(path.stat().st_mtime for path in (*source.glob("*/*"), Path(__file__)))
            library = (
                package / f"{source.name}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
            )
            if not library.exists() or library.stat().st_mtime < newest:
                shutil.rmtree(package, ignore_errors=True)
                make_package(source, made / "sources" / source.name, library, made / "lib")
                _describe(source, share)
            included[str(package)] = source.name
        build_data["shared_data"][str(made / "share")] = "share"
        # hatchling omits files that .gitignore names from a directory, but not from a list of files.
        for path in (made / "lib").iterdir():
            build_data["shared_data"][str(path)] = f"lib/{path.name}"


class BridgeTreeVersion(MetadataHookInterface):
    """Metadata hook that sets the version to that of the source tree, and pins dxlrun to the same version.

    The version is only defined in the pyproject.toml of dxlrun. An sdist has version and pin in its PKG-INFO.
    """

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Set version and dependencies from the pyproject.toml of dxlrun; an sdist has them already."""
        if "version" in metadata:
            return
        core = tomllib.loads((Path(self.root).parents[1] / "pyproject.toml").read_text("utf-8"))
        metadata["version"] = core["project"]["version"]
        metadata["dependencies"] = [f"dxlrun=={metadata['version']}", *self.config.get("dependencies", ())]


def make_package(source: Path, place: Path, library: Path, libraries: Path) -> None:
    """Generate C and Python sources from a package's message definitions, and compile them.

    Args:
        source: Directory of the definitions.
        place: Directory for the generated sources, which is emptied first.
        library: Extension module to build. The Python package is written next to it.
        libraries: Directory for the shared libraries that the module needs.
    """
    import rosidl_cli
    from rosidl_cli.command.hash.api import generate_type_hashes
    from rosidl_cli.command.translate.api import translate
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    prefix = Path(rosidl_cli.__file__).parents[4]
    # The generators search their templates in this path.
    os.environ["AMENT_PREFIX_PATH"] = str(prefix)
    shutil.rmtree(place, ignore_errors=True)
    name, out, includes = source.name, place / source.name, [str(prefix / "share")]
    files = [f"{source}:{path.relative_to(source)}" for path in sorted(source.glob("*/*"))]
    form = {"package_name": name, "include_paths": includes}
    written = [
        *map(Path, translate(interface_files=files, output_format="idl", output_path=place / "idl", **form))
    ]
    idl = [str(path) for path in written]
    hashes = [*map(Path, generate_type_hashes(interface_files=idl, output_path=out, **form))]
    # One call per directory, because types of two directories can have the same name.
    for folder in {path.parent.name for path in written}:
        own = [[str(path) for path in found if path.parent.name == folder] for found in (written, hashes)]
        GenerateC("c").generate(name, own[0], includes, out, own[1])
    GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]).generate(
        name, idl, includes, out
    )
    GenerateFastRTPSCTypesupport("fastrtps_c").generate(name, idl, includes, out)
    # A separate directory, because other generators write files of the same names.
    described = place / "described" / name
    GenerateIntrospectionCTypesupport("introspection_c").generate(name, idl, includes, described)
    GenerateCTypesupport("c", typesupport_implementations=list(SUPPORTS)).generate(name, idl, includes, out)
    _compile(source.name, place, prefix, library, libraries)
    for path in out.rglob("*.py"):
        copy = library.parent / path.relative_to(out)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)


def _compile(name: str, place: Path, prefix: Path, library: Path, libraries: Path) -> None:
    """Compile the generated sources of a message package; link its C libraries and its Python module. Raises
    RuntimeError without compilers, or if one fails."""
    include = sysconfig.get_paths()["include"]
    if not (shutil.which("gcc") and shutil.which("g++") and (Path(include) / "Python.h").exists()):
        raise RuntimeError(f"{name} has no wheel and is built here; install {NEEDED}")
    import numpy as np

    headers = prefix / "include"
    folders = [place, place / "described", Path(include), Path(np.get_include()), headers, *headers.iterdir()]
    flags = ["-O1", "-fPIC", "-w", f'-DROS_PACKAGE_NAME="{name}"', *(f"-I{folder}" for folder in folders)]
    # One file takes a quarter of the time, because all sources include the same long headers.
    whole = place / "whole.cpp"
    whole.write_text("".join(f'#include "{path}"\n' for path in sorted(place.rglob("*.cpp"))))

    def compiled(source: Path) -> str:
        result = f"{source}.o"
        _run("g++" if source is whole else "gcc", *flags, "-c", str(source), "-o", result)
        return result

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        sources = sorted(place.rglob("*.c"))
        plain = [*pool.map(compiled, [whole, *(path for path in sources if path.name[0] != "_")])]
        of_python = [*pool.map(compiled, [path for path in sources if path.name[0] == "_"])]
    used = [path.name for path in sorted((prefix / "lib").glob("lib*.so")) if USED.search(path.name)]
    linked = ["-Wl,--as-needed", f"-L{prefix / 'lib'}", f"-L{libraries}", *(f"-l:{one}" for one in used)]
    # Both type supports are linked into one library, which is copied to the name of the other.
    first, other = (f"lib{name}__{one}.so" for one in SUPPORTS)
    for folder in (libraries, library.parent):
        folder.mkdir(parents=True, exist_ok=True)
    _run("g++", "-shared", "-s", "-o", str(libraries / first), *plain, *linked)
    shutil.copyfile(libraries / first, libraries / other)
    _run("g++", "-shared", "-s", "-o", str(library), *of_python, f"-L{libraries}", f"-l:{first}", *linked)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")


def _describe(source: Path, share: Path) -> None:
    """Copy message definitions to `share`, and write the index in which `ros2 interface` finds them."""
    names = [f"{path.parent.name}/{path.name}" for path in sorted(source.glob("*/*"))]
    for name in names:
        copy = share / source.name / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, copy)
    for kind, text in (("packages", ""), ("rosidl_interfaces", "\n".join(names))):
        index = share / "ament_index/resource_index" / kind / source.name
        index.parent.mkdir(parents=True, exist_ok=True)
        index.write_text(text)
