"""`playground-bench`: runs measurements, each in its own process, and writes a page from the rows.

arguments    parses and checks `key=value` of the command line
commands     options and measurements of each command
schema       columns of a row, and the CSV files of rows
jobs         runs measurements as jobs of the sweep's runner; rows are written at once, and measured once
worker       the process of a measurement, which calls `measures/`, the only part that needs JAX
peer/        drives the public package in its own environment
golden       checks whole runs against windows
gate         checks ratios of a quick set against committed ones
record       appends finished runs to the tables of results/reference
run_columns  describes a run directory in the columns of these tables
report       writes one page from all rows
"""
