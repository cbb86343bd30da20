"""Tooling: public names for packages with verbs that read logs, run robots or connect to running robots.

It is one of the two public interfaces of dxlrun. The other, `dxlrun` itself, has the names for controllers
and sensors, the errors, `open_log` and `connect`. A package imports nothing else from dxlrun. The modules
here contain no code: each is a page of names, and each name is imported on first use.

| page | for |
|---|---|
| `verbs` | commands: options, input errors, missing extras |
| `output` | tables and sentences in the terminal and as JSON; files that are written |
| `html` | reports as HTML pages |
| `files` | a package's own YAML files, checked like robot files |
| `robots` | robot and motion files: reading, compiling |
| `plans` | the compiled robot, in runs and logs |
| `features` | sections that a package adds to the robot file |
| `runs` | running a robot: in processes, on virtual time |
| `servos` | single servos on a line that no run uses |
| `realtime` | processes with deadlines, like the loop |
| `live` | running robots: addresses, keys, live messages |
| `logs` | logs: finding, reading, following |
| `records` | the contents of a log: cycles, packets, events, commands |
| `topics` | names of topics, and their messages as bytes |
| `compiled_code` | C code that a package's build has compiled |

This verb counts the cycles of a log; the plug-in module of its package registers it:

    from pathlib import Path

    from dxlrun.tooling.logs import read_log
    from dxlrun.tooling.output import show_json
    from dxlrun.tooling.verbs import JsonFlag

    def cycles(log: Path, *, as_json: JsonFlag = False) -> int:
        show_json({"cycles": len(read_log(log).cycles)})
        return 0
"""
