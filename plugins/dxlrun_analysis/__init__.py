"""Analysis of logs: figures, a verdict with its reasons, and tables of the events of a run.

Each folder is one subject: cycles, servos, joints, causes and conduct, and the outputs built from them. The
log reader is in the core (`dxlrun.log`); experiments that produce logs are in `dxlrun_lab`.

Other packages may import `playback`, `replay` and `latency` with their modules, and `counts`, `plan` and
`cycles.latency`. Everything else is private.
"""
