"""HTML page of `dxlrun analyze --report`: zoomable plots of a run by Bokeh, in bounded size, and tables.

It shows results of other packages, and computes only the data of its plots.
"""
