"""The zoomable plots of a report: curves of a whole run in bounded size, drawn with Bokeh."""
