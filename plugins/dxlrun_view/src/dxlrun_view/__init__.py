"""dxlrun_view: a running robot, or a log, on a page in the browser."""
