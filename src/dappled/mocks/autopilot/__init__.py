"""A simulated autopilot, its flight path, its radio, and a ground station."""
