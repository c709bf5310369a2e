"""Measurements: suites of runs with their records, reports and figures, and the tables of README.md (`mrtamp bench`).

A suite (`suite`) says which planners plan which problems with which seeds; `execute` runs it, each run in a process of
its own (`run`, `measured`), and appends what came of it to a file of raw records (`records`); `report` makes tables and
figures of that file, whenever they are wanted.
"""
