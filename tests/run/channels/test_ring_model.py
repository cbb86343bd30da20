"""The ring's C code in every order that C11 allows, see ring_model.c; broken, the model finds it."""

import shutil
import subprocess
from pathlib import Path

import pytest

from dxlrun.channels.shared_memory import SOURCE

pytestmark = [pytest.mark.long, pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")]
MODEL = Path(__file__).with_name("ring_model.c")
RINGS = [  # writers, words of the ring, and of each record's payload
    "2 8 1 1 1",  # two records and a third one; each entry has three words more
    "1 4 1 1 1",  # the ring has one record
    "2 9 1 2 0",
    "2 6 0 0 3",  # the second writer's record is shorter than the one that the first died in
    "1 5 2 1 2",
    "1 7 0 1 2 1",
    "1 8 1 1 1 1",
]
BROKEN = {
    "the head is not released": ("STORE(&ring[HEAD], end, release)", "STORE(&ring[HEAD], end, relaxed)"),
    "the head is not acquired": ("if (LOAD(&ring[HEAD], acquire) <=", "if (LOAD(&ring[HEAD], relaxed) <="),
    "the intent is raised late": ("    FENCE(release);", "    "),
    "the intent is read before the copy": ("    FENCE(acquire);", "    "),
    "the intent is not read": ("return !is_overwritten(ring, capacity, position) &&", "return"),
    "the number is not released": ("number + 1u, release)", "number + 1u, relaxed)"),
    "the number is that of any head": (" && LOAD(&ring[LATEST], relaxed) < head)", ")"),
    "all is given up when the writer is faster": ("if (!is_overwritten(ring, capacity, oldest) && ", "if ("),
    "the head behind the intent is not acquired": (
        "head = LOAD(&ring[HEAD], acquire), copied",
        "head = LOAD(&ring[HEAD], relaxed), copied",
    ),
    "the newest head is not acquired": (
        "uint64_t head = LOAD(&ring[HEAD], acquire), latest",
        "uint64_t head = LOAD(&ring[HEAD], relaxed), latest",
    ),
    "the newest may be ahead of the head": ("if (latest < head && ", "if ("),
    "the intent goes back": ("STORE(&ring[INTENT], intent,", "STORE(&ring[INTENT], end,"),
    "nothing is published": ("    STORE(&ring[HEAD], end, release); ", "    "),
}


def model(folder: Path, source: str) -> Path:
    (folder / "ring.c").write_text(source)
    options = ["-std=c11", "-O1", f'-DSOURCE="{folder / "ring.c"}"', "-o", str(folder / "model"), str(MODEL)]
    subprocess.run([shutil.which("cc") or "cc", *options], check=True)
    return folder / "model"


def explored(program: Path, ring: str) -> tuple[bool, str]:
    done = subprocess.run([program, *ring.split()], capture_output=True, text=True, check=False)
    assert done.returncode in (0, 1), done
    return done.returncode == 0, done.stdout


def test_every_order_delivers_or_declares_each_record_once(tmp_path):
    program = model(tmp_path, SOURCE.read_text())
    for ring in RINGS:
        good, said = explored(program, ring)
        assert good, f"{ring}: {said}"
        assert int(said.split()[0]) > 500, said


def test_a_broken_ring_is_found(tmp_path):
    for what, (whole, broken) in BROKEN.items():
        source = SOURCE.read_text()
        assert source.count(whole) == 1, what
        program = model(tmp_path, source.replace(whole, broken))
        assert not all(explored(program, ring)[0] for ring in RINGS), what
