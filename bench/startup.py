"""Start-up of the commands, as multiples of importing numpy, pydantic and PyYAML in the same minute.

    python bench/startup.py [--rounds 9] [--no-bytecode]

The commands alternate with the import, so that a busy machine slows both alike; only the ratio of the medians
counts. Bytecode is cached, as an installed package has it; `--no-bytecode` measures a checkout that compiles
its sources at each start. Exit code 1 where a ratio is above its bound.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROBOT = "robots/bioloid_torso.yaml"
START = "import sys; from dxlrun.cli import main; sys.exit(main())"
IMPORT = "numpy, pydantic, yaml"
CASES = {
    "--version": (("--version",), 1.0),
    "--help": (("--help",), 1.0),
    f"check {ROBOT}": (("check", ROBOT), 2.8),
    f"{ROBOT} --virtual --duration 0.1": ((ROBOT, "--virtual", "--duration", "0.1"), 3.7),
}
"""Words after `dxlrun`, and the highest ratio to the import.

The libraries alone, with one pydantic model, are 1.7. The bounds are 7 % above the ratios of a quiet machine.
"""


def took_s(words: tuple[str, ...], environment: dict[str, str], directory: str) -> float:
    """Return how long one interpreter took from its start to its end, s."""
    start = time.perf_counter()
    subprocess.run(words, check=True, cwd=directory, env=environment, capture_output=True)
    return time.perf_counter() - start


def main() -> int:
    """Print the table; return 1 where a command is above its bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--no-bytecode", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = f"{directory}/bytecode"
        (Path(directory) / "robots").symlink_to(ROOT / "robots")
        imports = (sys.executable, "-c", f"import {IMPORT}")
        commands = {name: (sys.executable, "-c", START, *words) for name, (words, _) in CASES.items()}
        for words in (imports, *commands.values()):  # writes the bytecode, and warms the page cache
            took_s(words, environment, directory)
        if options.no_bytecode:
            environment |= {"PYTHONDONTWRITEBYTECODE": "1"}
            del environment["PYTHONPYCACHEPREFIX"]
        times: dict[str, list[float]] = {name: [] for name in ("import", *commands)}
        for _ in range(options.rounds):
            for name, words in commands.items():
                times["import"].append(took_s(imports, environment, directory))
                times[name].append(took_s(words, environment, directory))
    base = statistics.median(times["import"])
    print(f"{base:8.3f} s  python -c 'import {IMPORT}', median of {len(times['import'])}")
    failed = 0
    for name, (_, bound) in CASES.items():
        ratio = statistics.median(times[name]) / base
        failed += ratio > bound
        print(f"{ratio:8.2f} x  (at most {bound})  dxlrun {name}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
