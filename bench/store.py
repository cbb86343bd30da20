"""Store: what 100 logs in an object store take, to be copied there and to be asked.

Logs of virtual runs of 2 to 3 s are copied by `dxlrun upload` to a directory by file:
and to a server of S3 (moto, on this machine), and asked twice by `dxlrun logs`: the second time the table is
kept. Needs `pip install 'moto[server,s3]'`.

    python bench/store.py [--logs 100]
"""

from __future__ import annotations

import argparse
import logging
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import fsspec
from moto.server import ThreadedMotoServer
from tests.kit.answers import result_of

from dxlrun.testing import simulated_robot

ROBOT = Path(__file__).parents[1] / "robots" / "single_joint.yaml"
DXLRUN = Path(sys.executable).with_name("dxlrun")
QUESTION = ("--where", "cycles > 800", "--sort", "cycles DESC")


def main() -> None:
    """Make logs, copy them, ask, and print what each took."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--logs", type=int, default=100)
    count = parser.parse_args().logs
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # else the server shows each request
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "logs").mkdir()
        os.environ |= {"XDG_CACHE_HOME": folder, "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "me"}
        for number in range(count):
            log = place / "logs" / f"{number:03}.mcap"
            simulated_robot(ROBOT, duration_s=2.0 + 0.01 * number, log=log).run()
            os.utime(log, (1e9, 1e9))  # of a run that has ended
        size = sum(log.stat().st_size for log in (place / "logs").iterdir()) / 1e6
        sys.stdout.write(f"{count} logs, {size:.0f} MB\n")
        server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        server.start()
        host, port = server.get_host_and_port()
        os.environ["AWS_ENDPOINT_URL"] = f"http://{host}:{port}"
        fsspec.filesystem("s3", skip_instance_cache=True).mkdir("s3://lab")
        for url in (f"file://{place}/there", "s3://lab/torso"):
            timed("upload", place / "logs", url)
            timed("logs", url, *QUESTION)
            timed("logs", url, *QUESTION)
        server.stop()


def timed(verb: str, *words: object) -> None:
    """Run a command, and print how long it took, and of how many logs it told."""
    began = time.monotonic()
    done = subprocess.run([DXLRUN, verb, *map(str, words), "--json"], check=True, stdout=subprocess.PIPE)
    took, found = time.monotonic() - began, result_of(done.stdout)
    sys.stdout.write(f"{verb} {words[-1] if verb == 'upload' else words[0]}: {took:.1f} s, ")
    sys.stdout.write(f"{len(found.get('uploaded') or found['rows'])} logs\n")


if __name__ == "__main__":
    main()
