"""Analysis of logs: figures, a verdict with its reasons, and tables of what happened in a run.

Each folder is one subject: cycles, servos, joints, causes, conduct, and what is made of them. Reading a log
is not here but in the core (`dxlrun.log`); experiments that produce logs are in `dxlrun_lab`.

Other packages may import `playback`, `replay` and `latency` with their modules, and `counts`, `plan` and
`cycles.latency`. All else is private.
"""
