"""Tooling: the names for packages with verbs that read logs, run robots or connect to running ones.

It is one of the two faces of dxlrun; the other, `dxlrun` itself, has what controllers and sensors need, the
errors, `open_log` and `connect`. A package imports nothing else of dxlrun. No code of its own belongs here:
each module is a page of names, and each name is imported when it is first used.

| page | for |
|---|---|
| `verbs` | commands: their options, a wrong line, an extra that is missing |
| `output` | tables and sentences in the terminal and as JSON; files that are written |
| `html` | reports as HTML pages |
| `files` | YAML files of a package's own, checked as robot files are |
| `robots` | robot and motion files: read, compile |
| `plans` | the compiled robot, as a run and each log have it |
| `features` | sections that a package adds to the robot file |
| `runs` | running a robot: in processes, on virtual time |
| `servos` | single servos on a line that no run uses |
| `realtime` | processes that wait for deadlines as the loop does |
| `live` | robots that run: addresses, keys, messages as they come |
| `logs` | logs: finding, reading, following |
| `records` | the contents of a log: cycles, packets, events, commands |
| `topics` | names of topics, and their messages as bytes |

A verb that counts the cycles of a log, with this package's plug-in module naming it:

    from pathlib import Path

    from dxlrun.tooling.logs import read_log
    from dxlrun.tooling.output import show_json
    from dxlrun.tooling.verbs import JsonFlag

    def cycles(log: Path, *, as_json: JsonFlag = False) -> int:
        show_json({"cycles": len(read_log(log).cycles)})
        return 0
"""
