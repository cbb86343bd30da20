"""`dxlrun keys`: certificates that robots and their network clients present to each other (mutual TLS)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dxlrun import InputError
from dxlrun.tooling.live import Role
from dxlrun.tooling.output import Column, Table, show_json, show_parts
from dxlrun.tooling.verbs import DebugFlag, JsonFlag

if TYPE_CHECKING:
    from dxlrun_fleet.authority import IssuedCertificates

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}", re.ASCII)
MOST_DAYS = 3650


def keys(
    action: Literal["robot", "client", "renew", "revoke", "list"] = "list",
    name: str | None = None,
    /,
    *,
    role: Literal["observe", "command", "admin"] | None = None,
    days: int | None = None,
    output: Path | None = None,
    as_json: JsonFlag = False,
    debug: DebugFlag = False,
) -> int:
    """Create, renew and revoke certificates of robots and clients.

    The first use creates a certificate authority on this computer. Its private key remains on this computer.

    Parameters
    ----------
    action
        Action: robot NAME and client NAME create a certificate. renew NAME replaces it. revoke NAME makes the
        robots of this computer refuse it. list shows all certificates.
    name
        Name of a robot, as in its robot file, or of a client, as in the logs of robots.
    role
        Role of a client: observe, command, or admin. admin also changes registers, rates and controllers.
        Default: observe.
    days
        Validity of the certificate, days. Default: 365.
    output
        Output directory, to be copied to `~/.config/dxlrun/keys` of another computer. Default: that directory
        of this computer.
    """
    try:
        from dxlrun_fleet import authority
    except ImportError as error:
        raise InputError("`dxlrun keys` needs cryptography: pip install 'dxlrun[network]'") from error
    from dxlrun.tooling.live import CLIENT, keys_place, revoked

    _refuse_unused(action, {"--role": role, "--days": days, "--output": output, "a name": name})
    if action != "list":
        if name is None or not _NAME.fullmatch(name) or name in (CLIENT, "ca"):
            raise InputError(
                f"`dxlrun keys {action}` needs a name of letters, digits, _ . and -, such as torso"
            )
        days = 365 if days is None else days
        if not 0 < days <= MOST_DAYS:
            raise InputError(f"--days {days} is out of range; give 1 to {MOST_DAYS}")
        known = {one.name: one for one in authority.issued()}
        directory = keys_place() if output is None else output
        if action in ("robot", "client"):
            if name in known:
                raise InputError(
                    f"{name} already has a certificate; run `dxlrun keys renew {name}`, or give another name"
                )
            chosen = None if action == "robot" else Role[(role or "observe").upper()]
        elif name not in known:
            raise InputError(
                f"{name} has no certificate; existing certificates: {', '.join(known) or 'none'}"
            )
        else:
            chosen = None if known[name].role == "robot" else Role[known[name].role.upper()]
        if action == "revoke":
            authority.revoke(known[name])
            sentence = (
                f"robots of this computer refuse {name} now; "
                f"copy {keys_place() / 'revoked'} to other computers"
            )
        else:
            one = authority.issue(name, chosen, days, directory)
            where = (
                "" if output is None else f"; copy its files to ~/.config/dxlrun/keys of {name}'s computer"
            )
            sentence = f"{directory} has the certificate of {name} ({one.role}, {days} days){where}"
        if not as_json:
            show_parts(sentence)
            return 0
    rows = [
        {
            "name": one.name,
            "role": one.role,
            "until": one.certificate.not_valid_after_utc.date().isoformat(),
            "state": _state(one, revoked()),
            "serial": one.serials[0],
        }
        for one in authority.issued()
    ]
    if as_json:
        show_json(rows)
        return 0
    columns = [Column(name, "name") for name in ("name", "role", "until", "state")]
    show_parts(
        Table.from_rows("Certificates", columns, ([*row.values()][:4] for row in rows))
        if rows
        else "no certificates; create one with `dxlrun keys robot NAME` or `dxlrun keys client NAME`"
    )
    return 0


_ACTIONS_WITH = {
    "--role": ("client",),
    "--days": ("robot", "client", "renew"),
    "--output": ("robot", "client", "renew"),
    "a name": ("robot", "client", "renew", "revoke"),
}


def _refuse_unused(action: str, given: Mapping[str, object]) -> None:
    """Raise InputError for an option that was given a value but that the action does not use."""
    for option, value in given.items():
        if value is not None and action not in _ACTIONS_WITH[option]:
            actions = " and ".join(_ACTIONS_WITH[option])
            raise InputError(f"{option} is not for `dxlrun keys {action}`, only for {actions}; remove it")


def _state(one: IssuedCertificates, refused: frozenset[str]) -> str:
    if one.serials[0] in refused:
        return "revoked"
    return "valid" if one.certificate.not_valid_after_utc > datetime.now(UTC) else "expired"
