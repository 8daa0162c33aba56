"""What shows that a flight is as it was recorded: rows against the chain, and files against the seals."""
