"""Exchange: reads, goals and idle work of a bus, executed by the kernel in C or the parser in Python.

What is sent, and when, is decided by the plan. A servo's life belongs in the runtime.
"""
