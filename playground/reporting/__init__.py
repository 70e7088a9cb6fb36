"""Pages of tables and figures, for the results of sweeps and benchmarks.

page     a page as a list of blocks, written as Markdown or HTML; formatting of numbers
figures  drawings, as SVG or PNG
"""
