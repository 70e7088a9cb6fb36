"""Hides Warp from processes of `tests.processes.WITHOUT_WARP`."""

raise ImportError("Warp is hidden from this process.")
