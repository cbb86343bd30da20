"""Dynamixel servos on serial lines: control tables, packets, ports, and a cyclic exchange in C.

The library does not know robots, logs or YAML. The mapping from servos to a robot belongs in
`dxlrun.dynamixel`. `import dxlwire` is light: each name is imported on first use. The names are listed only
in `__init__.pyi`, one per line.

A control table has the address, size and unit of every item of a servo model:

    >>> from dxlwire import find_table
    >>> item = find_table("XM430-W350").items["goal_position"]
    >>> item.address, item.size, item.unit
    (116, 4, 'rad')

A dialect builds and parses the packets of a protocol:

    >>> from dxlwire import dialect_of
    >>> packets = dialect_of(2.0)
    >>> packets.write_range(1, item.address, item.encode(2048)).hex(" ")
    'ff ff fd 00 01 09 00 03 74 00 00 08 00 00 42 89'
"""

from dxlwire.faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, f"{__file__.rpartition('.')[0]}.pyi")
