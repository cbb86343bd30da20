"""Page of `analyze --report`: curves of a whole run in bounded size, zoomable plots by Bokeh, tables.

It shows results of other packages, and computes only the data of its plots.
"""
