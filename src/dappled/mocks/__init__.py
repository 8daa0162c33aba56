"""Simulated camera, camera body, autopilot and ground station. They ship: the demo runs on them."""
