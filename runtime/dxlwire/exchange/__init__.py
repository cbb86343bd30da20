"""Exchange: reads, goals and idle work of a bus, executed by the kernel in C or the parser in Python.

The plan decides which packets are sent, and when. The life cycle of a servo belongs in the runtime.
"""
