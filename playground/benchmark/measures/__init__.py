"""The measurements that a worker runs: modules with `measure(facts, **arguments)`."""
