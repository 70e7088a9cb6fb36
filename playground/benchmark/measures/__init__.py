"""Holds the measurements that a worker runs: modules with `measure(rows, **arguments)`."""
