"""Control tables: addresses and units of the control items of each servo and device model.

`find_table("AX-12A")` is the table of a model, `find_table("MX-28", 2.0)` that of one of its firmwares.
Each model has a data file in `tables/`."""

from dxlwire.control_table.control_items import CAPABILITIES as CAPABILITIES
from dxlwire.control_table.control_items import SIGN_BIT as SIGN_BIT
from dxlwire.control_table.control_items import Access as Access
from dxlwire.control_table.control_items import Area as Area
from dxlwire.control_table.control_items import BaseControlTable as BaseControlTable
from dxlwire.control_table.control_items import ControlItem as ControlItem
from dxlwire.control_table.control_items import ControlTable as ControlTable
from dxlwire.control_table.control_items import EffortUnit as EffortUnit
from dxlwire.control_table.control_items import Encoding as Encoding
from dxlwire.control_table.control_items import FoundDeviation as FoundDeviation
from dxlwire.control_table.control_items import decoded as decoded
from dxlwire.control_table.control_items import find_deviations as find_deviations
from dxlwire.control_table.control_items import side_by_side as side_by_side
from dxlwire.control_table.hardware_errors import Fault as Fault
from dxlwire.control_table.hardware_errors import HardwareErrors as HardwareErrors
from dxlwire.control_table.servo_models import add_control_table as add_control_table
from dxlwire.control_table.servo_models import added_control_tables as added_control_tables
from dxlwire.control_table.servo_models import all_tables as all_tables
from dxlwire.control_table.servo_models import find_table as find_table
from dxlwire.control_table.servo_models import model_names as model_names
from dxlwire.control_table.servo_models import models_by_number as models_by_number
from dxlwire.control_table.servo_models import perhaps_meant as perhaps_meant
from dxlwire.control_table.servo_models import protocols_of as protocols_of
from dxlwire.control_table.table_files import read_control_table as read_control_table
