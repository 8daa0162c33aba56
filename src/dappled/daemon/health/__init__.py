"""The state of the daemon and its machine: health record, checks before a flight, log, status text, metrics."""
