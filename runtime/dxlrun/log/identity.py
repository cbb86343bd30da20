"""Identity: hashes of the files that a run is made of, the git revision of their folder, and the machine.

Kept in a log, so that two runs, or a run and its replay, can be compared: same inputs, same record.
"""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

from dxlrun.installed_plugins import distribution_name

IDENTITY_NAME = "identity"
"""The metadata record; docs/how-to/logs.md has its keys."""
ROBOT, INCLUDED, MOTION, URDF, PLUGIN, RUNTIME = "robot", "included", "motion", "urdf", "plugin", "runtime"
"""What a hash is of: the first word of its key; all but URDF and RUNTIME are followed by the file's name."""
HOST, KERNEL, REVISION, CHANGED = "host", "kernel", "git revision", "git changed"
"""Keys of what is no hash."""
_GIT_TIMEOUT_S = 2.0
"""For all questions to git together: a folder of a network may answer late, and the run waits for it."""
_MOST_FILES = 2_000
"""Of one package: a bound on the time before a run, not on packages."""
_BUILT = (".pyc", ".so")
"""Suffixes of what each machine makes of sources by itself."""


def identity(source_file: str, files: Mapping[str, str], packages: Mapping[str, str]) -> dict[str, str]:
    """Return the record of a run.

    Args:
        source_file: Path of the robot file.
        files: Texts by their keys, as `file_key` makes them.
        packages: The packages of plug-ins that run, with their distributions (`Plan.packages`).
    """
    folder = Path(source_file).parent
    return {
        **{key: sha256(text.encode()).hexdigest() for key, text in files.items()},
        **_imported(frozenset(packages.items())),
        **git_state(folder, Path(source_file).name),
        HOST: platform.node(),
        KERNEL: " ".join((platform.system(), platform.release(), platform.version(), platform.machine())),
    }


def file_key(what: str, name: str) -> str:
    """Return the key of a file: `included fragments/head.yaml`."""
    return f"{what} {name}"


def code_hashes(packages: Iterable[tuple[str, str]] = ()) -> dict[str, str]:
    """Return the hash of each file of some packages, and one of dxlrun's own code.

    `plugin DISTRIBUTION PACKAGE/FILE.py` -> SHA-256; a package counts from its top. Of a package with more
    than 2000 files only the first, by name.

    Args:
        packages: Top packages or modules with their distributions.
    """
    hashes: dict[str, str] = {}
    for module, distribution in sorted(packages):
        for number, (name, path) in enumerate(module_files(module)):
            if number == _MOST_FILES:
                break
            hashes[file_key(f"{PLUGIN} {distribution}", name)] = _hash_of(path)
    whole = sha256()
    for name, path in module_files("dxlrun"):
        if path.suffix not in _BUILT:
            whole.update(f"{name}\0{_hash_of(path)}\n".encode())
    return {**hashes, RUNTIME: whole.hexdigest()}


def package_of(key: str) -> tuple[str, str]:
    """Return package and distribution of a key of a plug-in's file."""
    distribution, _, name = key.removeprefix(file_key(PLUGIN, "")).rpartition(" ")
    return name.partition("/")[0].removesuffix(".py"), distribution


def changed_code(then: Mapping[str, str], publishers: Iterable[str]) -> tuple[str, ...]:
    """Return a sentence for each plug-in whose files differ from those of a run, and one for dxlrun itself.

    Args:
        then: The identity in the log of the run; empty in logs from before it was kept.
        publishers: The distributions of the plug-ins that the run used, with their versions.
    """
    if not then:
        return ()
    used = {distribution_name(publisher) for publisher in publishers}
    packages = {package_of(key) for key in then if key.startswith(file_key(PLUGIN, ""))}
    now = code_hashes(one for one in packages if one[1] in used)
    sentences = []
    if then.get(RUNTIME, now[RUNTIME]) != now[RUNTIME]:
        sentences.append("dxlrun itself has changed since the run")
    for name in sorted(used):
        prefix = file_key(f"{PLUGIN} {name}", "")
        own = sorted(key for key in {*then, *now} if key.startswith(prefix))
        changed = [key.removeprefix(prefix) for key in own if then.get(key) != now.get(key)]
        if changed:
            more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
            sentences.append(f"the plug-in {name} has changed since the run (file {changed[0]}{more})")
    return tuple(sentences)


def runtime_hash() -> str:
    """Return the hash of dxlrun's own code."""
    return code_hashes()[RUNTIME]


_imported = cache(code_hashes)
"""The code of this process, which imports it once."""


def module_files(module: str) -> list[tuple[str, Path]]:
    """Return the files of a top package or module, by their names from there; none where it has no place."""
    try:
        spec = find_spec(module)
    except (ImportError, ValueError):  # ValueError: it was put together in memory
        return []
    if spec is None:
        return []
    places = [Path(place) for place in spec.submodule_search_locations or [spec.origin or ""]]
    return sorted(_named(places))


def _named(places: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    for place in places:
        if place.is_file():
            yield place.name, place
            continue
        for folder, folders, files in os.walk(place):
            folders[:] = [name for name in folders if name != "__pycache__"]
            for name in files:
                path = Path(folder, name)
                if path.suffix != ".pyc" and path.is_file():
                    yield path.relative_to(place.parent).as_posix(), path


def _hash_of(path: Path) -> str:
    """Return the hash of a file, or why there is none."""
    try:
        return sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        return f"not readable: {error.strerror}"


def git_state(folder: Path, file: str) -> dict[str, str]:
    """Return the git revision of a folder, and whether what lies there differs from it; {} without git.

    `yes` also where git does not have the file itself. What git does not have beside it does not count: logs
    are written there.
    """
    if not any((place / ".git").exists() for place in (folder.absolute(), *folder.absolute().parents)):
        return {}  # the usual case of a robot's computer: no process is started
    give_up = time.monotonic() + _GIT_TIMEOUT_S
    status = _git(
        folder,
        ("status", "--porcelain=v2", "--branch", "--untracked-files=no", "--ignore-submodules", "--", "."),
        give_up,
    )
    if status is None:
        return {}
    oid = "# branch.oid "
    lines = status.splitlines()
    revision = next((line.removeprefix(oid) for line in lines if line.startswith(oid)), "(initial)")
    if revision == "(initial)":  # a repository without a commit
        return {}
    changed = any(not line.startswith("#") for line in lines)
    known = changed or _git(folder, ("ls-files", "--error-unmatch", "--", file), give_up) is not None
    return {REVISION: revision, CHANGED: "yes" if changed or not known else "no"}


def _git(folder: Path, arguments: tuple[str, ...], give_up: float) -> str | None:
    """Return what git prints; None when it is missing, fails or is too slow."""
    # no index is written and no program of the repository started: a run only looks
    command = ["git", "--no-optional-locks", "-c", "core.fsmonitor=false", *arguments]
    surroundings = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        found = subprocess.run(
            command,
            cwd=folder,
            env=surroundings,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=max(0.0, give_up - time.monotonic()),
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.decode(errors="replace")
