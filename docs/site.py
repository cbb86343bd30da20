"""Build the documentation site: `python docs/site.py` writes it to `site/`, and fails on any warning.

The pages are those of this folder, in the order of index.md, with the files outside of it that they link to.
Needs `pip install 'zensical>=0.0.73'`; `--into DIRECTORY` builds elsewhere.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).parent
ROOT = DOCS.parent
LINK = re.compile(r"\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def place_of(path: Path) -> Path:
    """Return where the site has a file: as in this folder; from outside, a page below `files`."""
    if path.is_relative_to(DOCS) and path.suffix in {".md", ".png", ".svg"}:
        return path.relative_to(DOCS)
    path = (path / "README.md" if path.is_dir() else path).relative_to(ROOT)
    return Path("files", path if path.suffix == ".md" else f"{path}.md")


def rewritten(text: str, page: Path, wanted: set[Path]) -> str:
    """Return a page with its links as on the site; `wanted` gets the files that they lead to."""

    def link(match: re.Match[str]) -> str:
        shown, linked, anchor = match.groups()
        if linked.startswith(("http:", "https:")):
            return match[0]
        path = Path(os.path.normpath(page.parent / linked))
        if path.suffix not in {".png", ".svg"}:
            wanted.add(path)
        if shown == path.name and path.suffix == ".md" and not anchor:  # a page is named by its title
            shown = path.read_text().partition("\n")[0].removeprefix("# ")
        return f"[{shown}]({os.path.relpath(place_of(path), place_of(page).parent)}{anchor or ''})"

    return LINK.sub(link, text)


def settings(index: str) -> str:
    """Return zensical.toml with the order of index.md: its sections, and their pages by their own titles."""
    parts = [{"Documentation": "index.md"}]
    for heading, body in re.findall(r"^## ([^\n]+)\n(.*?)(?=^## |\Z)", index, re.MULTILINE | re.DOTALL):
        parts.append({heading: [link for _, link, _ in LINK.findall(body)]})
    return re.sub(
        r"nav = \[\]",
        f"nav = {json.dumps(parts)}".replace('": ', '" = '),
        (DOCS / "zensical.toml").read_text(),
    )


def gather(source: Path) -> None:
    """Write all pages, pictures and what they link to below `source`."""
    shutil.copytree(DOCS / "pictures", source / "pictures", ignore=shutil.ignore_patterns("*.py", "*.json"))
    shutil.copy(DOCS / "site.css", source)
    shutil.copy(DOCS / "site.js", source / "iframe-worker.js")
    rest = {path for path in DOCS.rglob("*.md") if path.parent.name != "changes"}
    done: set[Path] = set()
    while rest:
        path = rest.pop()
        done.add(path)
        file, target = path / "README.md" if path.is_dir() else path, source / place_of(path)
        if file.suffix == ".md":
            text = rewritten(file.read_text(), file, rest)
            rest -= done
        else:
            text = f"# {file.name}\n\n````{file.suffix[1:]}\n{file.read_text()}````\n"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)


def build(into: Path) -> int:
    """Build the site in a directory; return the exit code of zensical."""
    if importlib.util.find_spec("zensical") is None:
        sys.exit("the site needs zensical: pip install 'zensical>=0.0.73'")
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        gather(place / "docs")
        (place / "zensical.toml").write_text(settings((place / "docs/index.md").read_text()))
        ran = subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=place, check=False)
        if ran.returncode == 0:
            shutil.rmtree(into, ignore_errors=True)
            shutil.move(place / "site", into)
    return ran.returncode


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--into", type=Path, default=ROOT / "site")
    sys.exit(build(parser.parse_args().into))
