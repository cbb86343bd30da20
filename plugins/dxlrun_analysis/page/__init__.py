"""The page of a report: curves of a whole run in bounded size, zoomable plots by Bokeh, tables."""
