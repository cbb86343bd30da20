"""dxlrun: the names for authors of plug-ins and for programs that steer a running robot; nothing else.

`import dxlrun` is light: each name is imported when it is first used, so that neither numpy nor pydantic is
loaded for a command line that only prints its help. The names stand in `__init__.pyi` alone, a line each.
Packages with verbs find the names of their trade in `dxlrun.tooling`.
"""

from dxlwire.faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, f"{__file__.rpartition('.')[0]}.pyi")
