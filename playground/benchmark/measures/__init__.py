"""What a worker runs: a module each, with `measure(facts, **arguments)`."""
