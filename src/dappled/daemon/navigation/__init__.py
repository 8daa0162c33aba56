"""Where the vehicle was and how it pointed at a given time."""
