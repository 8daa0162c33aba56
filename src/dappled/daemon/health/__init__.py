"""How the daemon and its machine are: health record, checks before flight, status text, metrics."""
