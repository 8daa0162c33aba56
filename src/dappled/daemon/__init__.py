"""The running service: shutter, clocks and poses, decode stage, publisher, MAVLink camera component, replay."""
