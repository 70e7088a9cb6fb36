"""What `playground-bench` does: measures, each in a process of its own, and tells a page from the rows.

arguments    `key=value` of the command line, checked
commands     what each command measures: its options, and the jobs they stand for
suites       the paper's tables and the tasks in them
schema       the columns of a row, and the CSV files that hold them
jobs         one process a measurement, rows written as they come, what is there is not measured again
worker       that process; `measures/` is what it runs, the only part that needs JAX
peer/        the public package, driven in an environment of its own
gate         ratios of a quick set against committed ones
report       one page from all rows
"""
