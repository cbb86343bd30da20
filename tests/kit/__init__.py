"""Helpers that several rooms of tests use. Each module has one subject.

whole robots          virtual_run, and in processes live_run and torso
one part of a robot   loops, stages, laws, rigs, plans, bodies
lines                 simulated_line, packets, line_faults, mixed_line, bus_ports, bus_process, exchanges
texts                 cases, and what runs them: told_stories, steering, servo_cases, tool_cases, robot_cases,
                      dialogues, commands
judges                wire, judges, storms, judged_arms, totals, kept_events
logs and files        made_logs, changed_logs, held_logs, decoded, robots, desk, examples, pages, packages
clients and people    hands, browser, fuzzed_http, experiments, answers
the suite itself      campaigns, selection, skips, nested, awaited, loaded
"""
