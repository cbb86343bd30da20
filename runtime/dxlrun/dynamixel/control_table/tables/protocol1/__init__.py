"""dynamixel/control_table/tables/protocol1"""
