"""MAVLink links: addresses, channels, framing, signing."""
