"""Output: tables and sentences in the terminal and as JSON, and files that a user names.

A table holds values; the terminal, JSON and HTML pages render it.

    from dxlrun.tooling.output import Column, Table, show_parts

    show_parts(Table.from_rows("Servos", [Column("joint"), Column("ID")], [["head_yaw_joint", 7]]))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.dynamixel.remedies import choose_remedy as choose_remedy
    from dxlrun.dynamixel.remedies import free_machine as free_machine
    from dxlrun.dynamixel.remedies import late_replies as late_replies
    from dxlrun.errors import counted as counted
    from dxlrun.output.live_view import show_live as show_live
    from dxlrun.output.quantity import quantity_text as quantity_text
    from dxlrun.output.target import check_target as check_target
    from dxlrun.output.target import new_target as new_target
    from dxlrun.output.target import unwritable as unwritable
    from dxlrun.output.target import write_target as write_target
    from dxlrun.output.terminal import err as err
    from dxlrun.output.terminal import fitted as fitted
    from dxlrun.output.terminal import out as out
    from dxlrun.output.terminal import print_error as print_error
    from dxlrun.output.terminal import print_warning as print_warning
    from dxlrun.output.terminal import progress_bar as progress_bar
    from dxlrun.output.terminal import show_json as show_json
    from dxlrun.output.terminal import show_parts as show_parts
    from dxlrun.output.text_table import Cell as Cell
    from dxlrun.output.text_table import Column as Column
    from dxlrun.output.text_table import Columns as Columns
    from dxlrun.output.text_table import Part as Part
    from dxlrun.output.text_table import Sentence as Sentence
    from dxlrun.output.text_table import Table as Table
    from dxlrun.output.text_table import Tone as Tone
    from dxlrun.output.text_table import Value as Value
    from dxlrun.output.text_table import flagged as flagged
    from dxlrun.output.text_table import microseconds as microseconds
    from dxlrun.output.text_table import numbers as numbers
    from dxlrun.output.unblocked import leave_real_time as leave_real_time
    from dxlrun.output.unblocked import unblocked as unblocked
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
