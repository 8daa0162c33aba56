"""The flight folder: layout, wishes, ledger, recorder, checks. Written by the daemon, read by everybody."""
