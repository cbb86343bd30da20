"""Identity: hashes of a run's input files and code, the git revision of their folder, and the machine.

The log keeps the identity, so that two runs, or a run and its replay, can be compared: same inputs, same
record.
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
"""Name of the log's metadata record with the identity; docs/how-to/logs.md has its keys."""
ROBOT, INCLUDED, MOTION, URDF, PLUGIN, RUNTIME = "robot", "included", "motion", "urdf", "plugin", "runtime"
"""First word of an entry's key: which kind of file was hashed. All but URDF and RUNTIME are followed by the
file's name."""
HOST, KERNEL, REVISION, CHANGED = "host", "kernel", "git revision", "git changed"
"""Keys of entries that are not hashes: host name, kernel, git revision, uncommitted changes."""
_GIT_TIMEOUT_S = 2.0
"""Timeout of all git commands together, s: a network folder may respond slowly, and the run waits."""
_MOST_FILES = 2_000
"""Most files of a plug-in package that are hashed, which bounds the delay before a run."""
_BUILT = (".pyc", ".so")
"""Suffixes of files that are not hashed in dxlrun's own code, because each machine builds them."""


def identity(source_file: str, files: Mapping[str, str], packages: Mapping[str, str]) -> dict[str, str]:
    """Return all hashes and facts that identify a run, as key and value for the log's metadata.

    Args:
        source_file: Path of the robot file.
        files: Texts by key, see `file_key`.
        packages: Packages of the used plug-ins, with their distributions (`Plan.packages`).
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
    """Return the key of a file's hash: `included fragments/head.yaml`."""
    return f"{what} {name}"


def code_hashes(packages: Iterable[tuple[str, str]] = ()) -> dict[str, str]:
    """Return the hash of each file of plug-in packages, and one hash of all of dxlrun's own code.

    Keys are `plugin DISTRIBUTION PACKAGE/FILE.py`, values SHA-256. Package paths begin at the top package.
    Only the first 2000 files of a package, by name, are hashed.

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
        if not name.endswith(_BUILT):
            whole.update(f"{name}\0{_hash_of(path)}\n".encode())
    return {**hashes, RUNTIME: whole.hexdigest()}


def package_of(key: str) -> tuple[str, str]:
    """Split the key of a plug-in's file into Python package and distribution."""
    distribution, _, name = key.removeprefix(file_key(PLUGIN, "")).rpartition(" ")
    return name.partition("/")[0].removesuffix(".py"), distribution


def changed_code(then: Mapping[str, str], publishers: Iterable[str]) -> tuple[str, ...]:
    """Compare installed code with a log's identity; return a sentence per changed plug-in, and for dxlrun.

    Args:
        then: Identity in the log of the run; empty in logs of earlier versions.
        publishers: Distributions of the plug-ins in the run, with their versions.
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
    """Return one hash of all files of dxlrun's own code."""
    return code_hashes()[RUNTIME]


_imported = cache(code_hashes)
"""`code_hashes`, computed once per process, because a process imports its code only once."""


def module_files(module: str) -> list[tuple[str, str]]:
    """Return the files of a Python package or module; empty if not found.

    Each has its path relative to the module's parent, and its path. They are strings, because a `Path` takes
    ten times as long, and dxlrun has hundreds of files.
    """
    try:
        spec = find_spec(module)
    # ValueError: the module was created in memory.
    except (ImportError, ValueError):
        return []
    if spec is None:
        return []
    return sorted(_named(spec.submodule_search_locations or [spec.origin or ""]))


def _named(places: Iterable[str]) -> Iterator[tuple[str, str]]:
    for place in places:
        if os.path.isfile(place):
            yield os.path.basename(place), place
            continue
        for folder, folders, files in os.walk(place):
            folders[:] = [name for name in folders if name != "__pycache__"]
            below = Path(folder).relative_to(Path(place).parent).as_posix()
            for name in files:
                path = os.path.join(folder, name)
                if not name.endswith(".pyc") and os.path.isfile(path):
                    yield f"{below}/{name}", path


def _hash_of(path: str) -> str:
    """Return the SHA-256 of a file, or `not readable: REASON`."""
    try:
        with open(path, "rb") as file:
            return sha256(file.read()).hexdigest()
    except OSError as error:
        return f"not readable: {error.strerror}"


def git_state(folder: Path, file: str) -> dict[str, str]:
    """Return git revision of a folder and whether files in it differ from it; empty without git.

    `yes` also means that git does not track the robot file itself. Other untracked files are ignored, because
    logs are written there.
    """
    if not any((place / ".git").exists() for place in (folder.absolute(), *folder.absolute().parents)):
        # The usual case on a robot's computer: git is not started.
        return {}
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
    # The repository has no commit.
    if revision == "(initial)":
        return {}
    changed = any(not line.startswith("#") for line in lines)
    known = changed or _git(folder, ("ls-files", "--error-unmatch", "--", file), give_up) is not None
    return {REVISION: revision, CHANGED: "yes" if changed or not known else "no"}


def _git(folder: Path, arguments: tuple[str, ...], give_up: float) -> str | None:
    """Run git in a folder and return its output; None if it fails, or runs beyond `give_up` (monotonic s)."""
    # Neither write the index nor start a program that the repository configures: a run only reads.
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
