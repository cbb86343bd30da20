"""dynamixel/control_table/tables/protocol2"""
