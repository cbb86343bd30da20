"""The page on real time says what the program does."""

import re
from types import ModuleType
from typing import get_args

import pluggy
from tests.kit.pages import page_text

from dxlrun.contract.hookspecs import GROUP, HookSpecs
from dxlrun.control.schedule import MOST_CAUGHT_UP
from dxlrun.description.robot import Scheduler
from dxlrun.plan.loop_plan import OverrunPolicy

PAGE = page_text("real-time.md")


def test_the_hook_of_the_page_is_one():
    (source,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    module = ModuleType("page")
    exec(source, module.__dict__)  # noqa: S102 (it is our own page)
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(HookSpecs)
    manager.register(module)  # raises for what is no hook
    manager.check_pending()
    assert module.dxlrun_overrun(0, 50_000_001) == "stop"
    assert module.dxlrun_overrun(0, 50_000_000) is None


def test_every_policy_for_late_cycles_is_on_the_page():
    assert set(re.findall(r"^\| `(\w+)` \| [a-z]", PAGE, re.MULTILINE)) >= set(get_args(OverrunPolicy))
    assert f"up to {MOST_CAUGHT_UP} late cycles follow at once" in PAGE


def test_every_request_is_on_the_page():
    assert Scheduler.model_fields
    for key in Scheduler.model_fields:
        assert f"`{key}`" in PAGE, key
