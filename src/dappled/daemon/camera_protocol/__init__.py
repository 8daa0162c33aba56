"""The MAVLink camera: commands, messages, parameters, files."""
