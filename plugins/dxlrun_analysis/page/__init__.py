"""Page of `analyze --report`: curves of a whole run in bounded size, zoomable plots by Bokeh, tables.

It shows what other packages computed, and computes only what a plot needs.
"""
