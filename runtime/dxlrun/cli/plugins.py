"""`dxlrun plugins` and `dxlrun new-plugin`: list the plug-ins of dxlrun, and create one from a template."""

from __future__ import annotations

import keyword
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dxlrun.cli.inputs import DebugFlag, JsonFlag
from dxlrun.errors import DxlrunError, InputError
from dxlrun.output.target import make_folder_of, new_target
from dxlrun.output.terminal import show_json, show_parts
from dxlrun.output.text_table import Column, Columns, Table, Value

if TYPE_CHECKING:
    from pydantic import BaseModel

    from dxlrun.control.controllers.offers import OfferStage
    from dxlrun.control.controllers.plugin_loading import LoadedPlugIn, Offer, PlugIns
    from dxlrun.features.feature import Feature

_NAME = re.compile(r"[a-z][a-z0-9]*([-_][a-z0-9]+)*")
_LONGEST_NAME = 60
_TEMPLATE = "easing"
_LEFT_OUT = ("LICENSE",)
_NOT_COPIED = ("__pycache__", ".pytest_cache", "logs", "dist", "build")
_OWNED = re.compile(r"^(license|license-files|authors) = .*\n", re.MULTILINE)
"""Lines of the template's pyproject.toml that are removed: the author of a new package writes their own."""
_LICENCE = re.compile(r"\n## Licence\n.*", re.DOTALL)
Row = dict[str, Any]
"""Row of `plugins --json`: one plug-in."""


def plugins(*, as_json: JsonFlag = False, debug: DebugFlag = False) -> int:
    """List the installed plug-ins: controllers, servo models, drivers and commands of each."""
    from dxlrun.control.controllers.plugin_loading import load_plugins

    found = load_plugins()
    rows = [_shown(one, found) for one in found.loaded]
    rows += [_row(name, broken=reason) for name, reason in found.broken.items()]
    if as_json:
        show_json(rows)
    else:
        show_parts(
            *(_table(row) for row in rows if not row["broken"]),
            *(f"broken: {row['broken']}" for row in rows if row["broken"]),
        )
    return 0


def _row(name: str, distribution: str = "", contract: int | None = None, *, broken: str) -> Row:
    """Return the row of a plug-in that offers nothing; `broken`: reason why it cannot be used, empty if it
    can.
    """
    about = {"name": name, "distribution": distribution, "contract": contract}
    offers = {"controllers": (), "servo_models": (), "overrun": False, **_drivers(), "verbs": ()}
    return about | offers | {"broken": broken}


def _shown(plugin: LoadedPlugIn, found: PlugIns) -> Row:
    controllers = (found.controllers.get(name) for name in plugin.controllers)
    drivers = {
        feature.name: [
            {"type": one.type, **stage.facts(one.driver)}
            for name in plugin.drivers[feature.name]
            if (one := found.drivers_of(feature.name).get(name)) is not None
        ]
        for feature, stage in _offer_stages()
    }
    return _row(plugin.name, plugin.distribution, plugin.contract, broken="") | {
        "controllers": [_controller(offer) for offer in controllers if offer is not None],
        "servo_models": plugin.servo_models,
        "overrun": plugin.overrun is not None,
        **drivers,
        "verbs": plugin.verbs,
    }


def _offer_stages() -> Iterator[tuple[Feature, OfferStage]]:
    """Yield the features for which plug-ins can provide drivers, each with its stage that describes them."""
    # Imported here because `--help` loads no pydantic.
    from dxlrun.control.controllers.offers import OfferStage
    from dxlrun.features import FEATURES, stages

    return stages(OfferStage, FEATURES)


def _drivers() -> dict[str, tuple[()]]:
    return {feature.name: () for feature, _ in _offer_stages()}


def _controller(offer: Offer) -> Row:
    kind = offer.controller
    return {
        "type": offer.type,
        "commands": [name for name in kind.Commands if name not in kind.Goals],
        "goals": [name for name in kind.Commands if name in kind.Goals],
        "topics": [*kind.Topics, *kind.publishes],
        "references": _references(offer),
        "live": list(_live(kind.Parameters)),
    }


def _live(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    from pydantic import BaseModel

    from dxlrun.contract.controller import LIVE

    for name, field in model.model_fields.items():
        if LIVE in field.metadata:
            yield prefix + name
        elif isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _live(field.annotation, f"{prefix}{name}.")


def _references(offer: Offer) -> tuple[str, ...]:
    """Return the references (inputs) that a controller has on one joint with default parameters; empty on
    failure.
    """
    try:
        # A model of foreign code, whose fields are unknown.
        given: dict[str, Any] = {"joints": ("joint",)}
        parameters = offer.controller.Parameters.model_construct(**given)
        return tuple(offer.controller.interfaces(parameters, ("joint",)).reference)
    # Foreign code may raise any exception, and parameters may have no defaults.
    except Exception:
        return ()


def _offered(name: str) -> tuple[Column, Callable[[Row], Value]]:
    column = Column(name, "text", detail=name == "references")
    return column, lambda row: ", ".join(row.get(name, ()))


_OFFERS: Columns[Row] = [
    (Column("offers", "name"), "type"),
    *map(_offered, ("commands", "goals", "topics", "references")),
]


def _table(row: Row) -> Table:
    """Return the table of a plug-in, with a line for each controller, driver, servo model and command it
    offers.
    """
    others = [
        *(f"{stage.kind} {one['type']}" for feature, stage in _offer_stages() for one in row[feature.name]),
        *(f"servo model {name}" for name in row["servo_models"]),
        *(f"command {name}" for name in row["verbs"]),
        *["decisions about late cycles"] * row["overrun"],
    ]
    offered = [*row["controllers"], *({"type": name} for name in others)]
    title = f"{row['name']} ({row['distribution']}, contract {row['contract']})"
    return Table.listing(title, _OFFERS, offered or [{"type": "nothing"}])


def new_plugin(
    name: str, directory: Path | None = None, /, *, as_json: JsonFlag = False, debug: DebugFlag = False
) -> int:
    """Create a package with a new controller, a robot file and a test.

    Parameters
    ----------
    name
        Name of the package, such as my_robotics.
    directory
        Directory to create. Default: the name of the package.
    """
    module = _module(name)
    place = Path(name) if directory is None else directory
    files = dict(_files(_template(), module))
    make_folder_of(place)
    with new_target(place) as beside:
        for path, text in files.items():
            target = beside / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
    made = [str(place / path) for path in files]
    if as_json:
        show_json({"directory": str(place), "files": made})
        return 0
    show_parts(
        *made,
        f"next: cd {place} && pip install -e '.[test]' && python -m pytest",
    )
    return 0


def _module(name: str) -> str:
    """Return the module name for a new package's name; raises InputError if it is invalid or taken."""
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name) or len(name) > _LONGEST_NAME:
        raise InputError(
            f"{name[:80]!r} is not a valid name of a package; write a letter, then lower-case letters, "
            f"digits, - or _, such as my_robotics (at most {_LONGEST_NAME} characters)"
        )
    if keyword.iskeyword(module) or module in sys.stdlib_module_names or _known(module):
        raise InputError(f"a Python module {module} exists already; choose another name, such as my_{module}")
    return module


def _known(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def _template() -> Path:
    """Return the directory of the template plug-in, in the installed package or in an editable clone.

    Raises DxlrunError when it is missing.
    """
    package = Path(__file__).parents[1]
    for place in (package / "plugin_template", package.parents[1] / "plugins" / "example"):
        if place.is_dir():
            return place
    raise DxlrunError("this installation of dxlrun has no template of a plug-in; reinstall it")


def _files(template: Path, module: str) -> Iterator[tuple[Path, str]]:
    """Yield path and text of each file of a new package: those of the template, renamed for `module`."""
    renamed: Mapping[str, str] = {
        f"dxlrun_{_TEMPLATE}": module,
        f"dxlrun-{_TEMPLATE}": module.replace("_", "-"),
        f"{_TEMPLATE}_position_controller": f"{module}_controller",
        f"{_TEMPLATE}_example": f"{module}_example",
        f"\n{_TEMPLATE} = ": f"\n{module} = ",
        f"test_{_TEMPLATE}": f"test_{module}",
    }
    for path in sorted(template.rglob("*")):
        relative = path.relative_to(template)
        if not path.is_file() or relative.name in _LEFT_OUT or set(relative.parts) & set(_NOT_COPIED):
            continue
        where, text = str(relative), path.read_text(encoding="utf-8")
        for old, new in renamed.items():
            where, text = where.replace(old, new), text.replace(old, new)
        if relative.name == "pyproject.toml":
            text = _OWNED.sub("", text)
        elif relative.name == "README.md":
            text = _LICENCE.sub("", text)
        yield Path(where), text
