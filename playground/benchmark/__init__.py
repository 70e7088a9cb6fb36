"""`playground-bench`: runs measurements, each in a process of its own, and makes a page of the rows.

arguments    `key=value` of the command line, checked
commands     the commands: options and measurements of each
schema       the columns of a row, and the CSV files that hold them
jobs         measurements as jobs of the sweep's runner; rows are written at once, and measured once
worker       the process of a measurement; `measures/` are its functions, the only part that needs JAX
peer/        the public package, driven in an environment of its own
gate         ratios of a quick set against committed ones
report       one page from all rows
"""
